"""Blender objects from stages, and edits from Blender objects.

| module | holds |
|---|---|
| `importer` | a whole scene: collections, objects, cameras, world |
| `splats` | the object of one splat prim: vertices with attributes |
| `nodes` | Geometry Nodes: an ellipsoid on every vertex |
| `material` | Gaussian falloff along the ray |
| `animation` | keyframes from tracks |
| `exporter` | what changed, as a layer of edits |
| `interface` | menu entries and panel |
"""
