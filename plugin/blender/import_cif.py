"""Import a stage into Blender without a window.

    blender -b -P import_cif.py -- out.usda --save out.blend
    python import_cif.py out.usda --save out.blend --render frame.png --frame 36      (with the bpy wheel)

`import_stage(path)` does the same from Python and returns the created objects; `export_edits(stage, out)`
writes what changed since as a USD layer over the stage.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import ModuleType

import bpy

HERE = str(Path(__file__).resolve().parent)


def import_stage(path: str | Path, **options: bool) -> list[bpy.types.Object]:
    """Create the objects of a stage in the current scene and return them; options as `Options` names them."""
    imported = _importer().import_scene(path, **options)
    for warning in imported.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return [imported.root, *imported.objects, *imported.cameras]


def export_edits(stage_path: str | Path, out_path: str | Path) -> Path:
    """Write what changed in the current scene since the import as a layer over the stage; the written file."""
    _importer()
    from cif_scene.blender import exporter

    return exporter.export_edits(stage_path, out_path)


def _importer() -> ModuleType:
    if HERE not in sys.path:
        sys.path.insert(0, HERE)
    bpy.utils.expose_bundled_modules()
    from cif_scene.blender import importer

    return importer


def main() -> int:
    """Import, and save or render on request."""
    argv = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", type=Path)
    parser.add_argument("--save", type=Path, help="write the .blend here")
    parser.add_argument("--render", type=Path, help="render one frame into this picture")
    parser.add_argument("--frame", type=int, help="frame to render (default: the first)")
    parser.add_argument("--camera", help="camera to render from (default: the first)")
    parser.add_argument(
        "--samples", type=int, default=1, help="samples per pixel (default: 1, at its centre, as in training)"
    )
    parser.add_argument("--one-colour", action="store_true", help="leave out colours that depend on the view")
    parser.add_argument("--display-blending", action="store_true", help="blend as training does, see README")
    parser.add_argument("--ellipsoids", action="store_true", help="render ellipsoids instead of discs")
    options = parser.parse_args(argv)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    import_stage(
        options.stage,
        harmonics=not options.one_colour,
        display_blending=options.display_blending,
        discs=not options.ellipsoids,
    )
    scene = bpy.context.scene
    if options.camera:
        scene.camera = bpy.data.objects[options.camera]
    if options.frame is not None:
        scene.frame_set(options.frame)
    if options.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(options.save.resolve()))
    if options.render:
        scene.cycles.device, scene.cycles.samples = "CPU", options.samples
        if options.samples == 1:
            scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
        scene.render.filepath = str(options.render.resolve())
        bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
