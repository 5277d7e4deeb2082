"""Stages in, layers of edits out; no Blender.

| module | holds |
|---|---|
| `scene` | what a stage says, as plain arrays |
| `tracks` | poses over time: interpolation, decomposition, comparison |
| `color` | display-referred and linear colour |
| `read` | stage to `scene` |
| `edits` | a layer that overrides a stage |
"""
