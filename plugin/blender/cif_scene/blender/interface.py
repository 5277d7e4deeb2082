"""Menu entries and the panel."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from . import animation, importer, nodes
from .importer import PRIM, STAGE
from .splats import MODIFIER


def instances(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Objects of instances in the scene, by label and then by name."""
    found = [obj for obj in context.scene.objects if PRIM in obj]
    return sorted(found, key=lambda obj: (str(obj.get("label", "")), obj.name))


def family(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """An object and its parts."""
    return [obj, *obj.children_recursive]


def is_hidden(obj: bpy.types.Object) -> bool:
    """Whether an object was hidden by hand; hidden over time is not."""
    return obj.hide_get()


def hide(obj: bpy.types.Object, hidden: bool) -> None:
    """Hide an object and its parts in viewport and renders, or show them as recorded."""
    for each in family(obj):
        each.hide_set(hidden)
        recorded = [curve for curve in animation.fcurves(each) if curve.data_path == "hide_render"]
        for curve in recorded:
            curve.mute = hidden
        # What the curves say comes back with the next evaluation.
        each.hide_render = hidden


class ImportCifScene(bpy.types.Operator, ImportHelper):
    """Import a stage written by `cif export`, or any stage with Gaussian splats."""

    bl_idname = "import_scene.cif"
    bl_label = "Import CIF scene"
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012  (how Blender wants it)

    filename_ext = ".usdc"
    filter_glob: StringProperty(default="*.usd;*.usda;*.usdc;*.usdz", options={"HIDDEN"})
    harmonics: BoolProperty(
        name="View-dependent Colour", description="Colours as seen from the scene's camera", default=True
    )
    training_blur: BoolProperty(
        name="Training Blur", description="Widen splats as training does on the recorded images", default=True
    )
    discs: BoolProperty(
        name="Discs in Renders",
        description="Render what the camera sees of the splats, sorted as in training; otherwise ellipsoids",
        default=True,
    )
    display_blending: BoolProperty(
        name="Display Blending",
        description="Blend as training does and show without a view transform; other objects look wrong",
        default=False,
    )
    set_scene: BoolProperty(
        name="Set Up Scene",
        description="Take frames, camera, resolution, world and render settings",
        default=True,
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import the chosen file."""
        try:
            imported = importer.import_scene(
                self.filepath,
                harmonics=self.harmonics,
                training_blur=self.training_blur,
                discs=self.discs,
                display_blending=self.display_blending,
                set_scene=self.set_scene,
            )
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in imported.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"{len(imported.objects)} objects, {len(imported.cameras)} cameras")
        return {"FINISHED"}


class ExportCifEdits(bpy.types.Operator, ExportHelper):
    """Write what changed since the import as a USD layer, for `cif import LAYER --base scene.cif`."""

    bl_idname = "export_scene.cif_edits"
    bl_label = "Export CIF edits"

    filename_ext = ".usda"
    filter_glob: StringProperty(default="*.usda;*.usdc", options={"HIDDEN"})
    stage: StringProperty(
        name="Stage",
        description="The stage that was imported, where it is not where it was",
        subtype="FILE_PATH",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where something was imported."""
        return any(STAGE in obj for obj in context.scene.objects)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the chosen file."""
        from . import exporter

        stages = sorted({obj[STAGE] for obj in context.scene.objects if STAGE in obj})
        if not self.stage and len(stages) > 1:
            self.report({"ERROR"}, f"several stages were imported; choose one: {', '.join(stages)}")
            return {"CANCELLED"}
        try:
            written = exporter.export_edits(self.stage or stages[0], self.filepath)
        except (ValueError, RuntimeError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"wrote {written}")
        return {"FINISHED"}


class CifInstance(bpy.types.Operator):
    """Select, hide or isolate the objects of one label, or one object."""

    bl_idname = "object.cif_instance"
    bl_label = "CIF instance"
    bl_options = {"UNDO"}  # noqa: RUF012

    action: EnumProperty(
        items=[
            ("SELECT", "Select", "Select it and nothing else; with shift also"),
            ("HIDE", "Hide", "Hide it, or show it again, in viewport and renders"),
            ("ISOLATE", "Isolate", "Hide all others; again: show all"),
            ("SHOW_ALL", "Show All", "Show everything as recorded"),
        ]
    )
    target: StringProperty(description="Name of the object; empty for all of a label")
    label: StringProperty(description="Label of the objects")
    extend: BoolProperty(description="Add to the selection")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Shift adds to the selection."""
        self.extend = event.shift
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it to the objects that fit."""
        everything = instances(context)
        chosen = [
            obj
            for obj in everything
            if (obj.name == self.target if self.target else obj.get("label") == self.label)
        ]
        if self.action == "SHOW_ALL":
            self._hide(everything, [])
        elif not chosen:
            self.report({"ERROR"}, f"no object {self.target or self.label}")
            return {"CANCELLED"}
        elif self.action == "SELECT":
            self._select(context, everything, chosen)
        elif self.action == "HIDE":
            hidden = not is_hidden(chosen[0])
            for obj in chosen:
                hide(obj, hidden)
        else:
            others = [obj for obj in everything if obj not in chosen]
            alone = all(is_hidden(obj) for obj in others) and not any(is_hidden(obj) for obj in chosen)
            self._hide(everything, [] if alone else others)
        context.scene.frame_set(context.scene.frame_current)
        return {"FINISHED"}

    def _fits(self, obj: bpy.types.Object) -> bool:
        return obj.name == self.target if self.target else obj.get("label") == self.label

    def _select(
        self, context: bpy.types.Context, everything: list[bpy.types.Object], chosen: list[bpy.types.Object]
    ) -> None:
        if not self.extend:
            for obj in context.view_layer.objects:
                obj.select_set(False)
        for obj in chosen:
            obj.select_set(True)
        context.view_layer.objects.active = chosen[0]

    @staticmethod
    def _hide(everything: list[bpy.types.Object], hidden: list[bpy.types.Object]) -> None:
        for obj in everything:
            hide(obj, obj in hidden)


class CifPanel(bpy.types.Panel):
    """Instances of the imported scene by label."""

    bl_idname = "VIEW3D_PT_cif_instances"
    bl_label = "CIF instances"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "CIF"

    def draw(self, context: bpy.types.Context) -> None:
        """A block per label, a row per object."""
        layout = self.layout
        found = instances(context)
        if not found:
            layout.operator(ImportCifScene.bl_idname, icon="IMPORT")
            return
        self._button(layout, "SHOW_ALL", "HIDE_OFF", text="Show All")
        labels = dict.fromkeys(str(obj.get("label", "")) for obj in found)
        for label in labels:
            box = layout.box()
            members = [obj for obj in found if obj.get("label") == label]
            row = box.row(align=True)
            row.label(text=f"{label} ({len(members)})")
            self._buttons(row, all(is_hidden(obj) for obj in members), label=label)
            for obj in members:
                row = box.row(align=True)
                row.prop(obj, '["display_name"]', text="")
                modifier = obj.modifiers.get(MODIFIER)
                if modifier is not None and modifier.node_group is not None:
                    tint = row.row()
                    tint.scale_x = 0.3
                    tint.prop(*nodes.input_of(modifier, nodes.TINT), text="")
                self._buttons(row, is_hidden(obj), target=obj.name)
        layout.operator(ExportCifEdits.bl_idname, icon="EXPORT")

    def _buttons(self, row: bpy.types.UILayout, hidden: bool, target: str = "", label: str = "") -> None:
        self._button(row, "SELECT", "RESTRICT_SELECT_OFF", target, label)
        self._button(row, "HIDE", "HIDE_ON" if hidden else "HIDE_OFF", target, label)
        self._button(row, "ISOLATE", "ZOOM_SELECTED", target, label)

    @staticmethod
    def _button(
        row: bpy.types.UILayout, action: str, icon: str, target: str = "", label: str = "", text: str = ""
    ) -> None:
        button = row.operator(CifInstance.bl_idname, text=text, icon=icon)
        button.action, button.target, button.label = action, target, label


CLASSES = (ImportCifScene, ExportCifEdits, CifInstance, CifPanel)


def _import_entry(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    self.layout.operator(ImportCifScene.bl_idname, text="CIF scene (USD)")


def _export_entry(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    self.layout.operator(ExportCifEdits.bl_idname, text="CIF edits (USD layer)")


def register() -> None:
    """Add classes and menu entries."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.TOPBAR_MT_file_import.append(_import_entry)
    bpy.types.TOPBAR_MT_file_export.append(_export_entry)


def unregister() -> None:
    """Take them away again."""
    bpy.types.TOPBAR_MT_file_export.remove(_export_entry)
    bpy.types.TOPBAR_MT_file_import.remove(_import_entry)
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
