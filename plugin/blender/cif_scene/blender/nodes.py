"""Geometry Nodes that draw every vertex as a Gaussian.

Attributes of the mesh: `rot` (quaternion), `scale` (standard deviations), `opacity`, `colour` (linear); `sh_0`
to `sh_15` where the colour depends on the view; `position_K`, `rot_K`, `scale_K` where the splats deform, and
`opacity_K` where they fade, K counting the samples.

In the viewport each vertex carries an ellipsoid. Renders from the scene's camera draw what it sees of them:
discs that are sorted by the depth of their centres, as in training, and crossed once by a ray instead of twice.
"""

from __future__ import annotations

import math

import bpy

from . import color_nodes, material, shape_nodes
from .graph import Graph, Value

NAME = "CIF splats"
SAMPLE = "Sample"
"""Input that picks the sample of splats that deform; fractions blend two of them."""
FADE = "Opacity Sample"
"""Input that picks the sample of splats that fade; fractions blend two of them."""
BLUR = "Pixel Angle"
"""Input with the angle of one recorded pixel, radians: training blurs splats by some pixels."""
VIEW = "Half View"
"""Input with half the size of the recorded image over its focal length, (x, y, 0)."""
NEAR = "Near"
"""Input with the depth below which a splat is not drawn, object units."""
DISPLAY = "Display Blending"
"""Input that leaves colours display-referred, to be shown without a view transform."""
TINT = "Tint"
"""Input with a linear colour that all colours are multiplied with; white leaves them."""
FACING = "Discs in Renders"
"""Input that draws discs that face the camera in renders; ellipsoids otherwise."""
TRANSFORM = "splat_transform"
SUBDIVISIONS = 2
INRADIUS = 0.9341723589627157
"""Radius of the sphere inside an icosphere of that many subdivisions (Blender counts the icosahedron as 1)."""
CORNERS = 12


def splat_nodes() -> bpy.types.GeometryNodeTree:
    """The node group, made once per file."""
    tree = bpy.data.node_groups.get(NAME)
    if tree is not None:
        return tree
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    tree.is_modifier = True
    for name, kind, value in (
        ("Geometry", "NodeSocketGeometry", None),
        (SAMPLE, "NodeSocketFloat", 0.0),
        (FADE, "NodeSocketFloat", 0.0),
        (BLUR, "NodeSocketFloat", 0.0),
        (VIEW, "NodeSocketVector", (1.0, 1.0, 0.0)),
        (NEAR, "NodeSocketFloat", 0.0),
        (TINT, "NodeSocketColor", (1.0, 1.0, 1.0, 1.0)),
        (DISPLAY, "NodeSocketBool", False),
        (FACING, "NodeSocketBool", True),
    ):
        socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        if value is not None:
            socket.default_value = value
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    graph = Graph(tree)
    given = graph.add("NodeGroupInput").outputs

    points = _deformed(graph, given["Geometry"], given[SAMPLE])
    points = _faded(graph, points, given[FADE])
    camera = shape_nodes.Camera(graph)
    lens = shape_nodes.Lens(given[BLUR], given[VIEW], given[NEAR])
    shape = shape_nodes.Shape(graph, camera, lens)
    viewport = graph.add("GeometryNodeIsViewport").outputs[0]
    facing = graph.add("FunctionNodeBooleanMath", {0: given[FACING], 1: viewport}, operation="NIMPLY").outputs[
        0
    ]
    transform = graph.switch(facing, shape.ellipsoid(), shape.disc(), "MATRIX")
    points = _store(graph, points, TRANSFORM, "FLOAT4X4", transform)
    color = color_nodes.color(graph, camera, given[TINT], given[DISPLAY])
    points = _store(graph, points, material.COLOR, "FLOAT_VECTOR", color)
    points = _store(graph, points, material.OPACITY, "FLOAT", graph.attribute("opacity", "FLOAT")[0])
    # The shader looks up two attributes of an instance; thousands of copies of the others would be waste.
    for name in ("rot", "scale", "opacity", "colour", "occupancy", "sh_*"):
        points = _remove(graph, points, name)
    instances = graph.add(
        "GeometryNodeInstanceOnPoints", {"Points": points, "Instance": _body(graph, facing)}
    ).outputs[0]
    instances = graph.add(
        "GeometryNodeSetInstanceTransform",
        {"Instances": instances, "Transform": graph.attribute(TRANSFORM, "FLOAT4X4")[0]},
    ).outputs[0]
    graph.add("NodeGroupOutput", {0: _remove(graph, instances, TRANSFORM)})
    graph.arrange()
    return tree


def set_input(modifier: bpy.types.NodesModifier, name: str, value: float | bool | tuple[float, ...]) -> str:
    """Set an input of the modifier by name; its data path in the object, to be animated."""
    owner, path = input_of(modifier, name)
    if owner != modifier:
        owner.value = value
        return owner.path_from_id(path)
    modifier[_identifier(modifier, name)] = value
    return modifier.path_from_id() + path


def input_of(modifier: bpy.types.NodesModifier, name: str) -> tuple[bpy.types.bpy_struct, str]:
    """Owner of an input's value and the path of the value there, as `UILayout.prop` takes them."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):  # since Blender 5.2; custom properties of the modifier before
        return getattr(modifier.properties.inputs, identifier), "value"
    return modifier, f'["{identifier}"]'


def _identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    items = modifier.node_group.interface.items_tree
    return next(item.identifier for item in items if item.name == name and item.in_out == "INPUT")


def _body(graph: Graph, facing: Value) -> bpy.types.NodeSocket:
    """Ball or disc that holds the unit sphere or circle."""
    ball = graph.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0 / INRADIUS, "Subdivisions": SUBDIVISIONS})
    disc = graph.add("GeometryNodeMeshCircle", fill_type="TRIANGLE_FAN")
    graph.give(disc.inputs["Vertices"], CORNERS)
    graph.give(disc.inputs["Radius"], 1.0 / math.cos(math.pi / CORNERS))
    body = graph.switch(facing, ball.outputs["Mesh"], disc.outputs["Mesh"], "GEOMETRY")
    return graph.add("GeometryNodeSetMaterial", {0: body, 2: material.splat_material()}).outputs[0]


def _store(graph: Graph, geometry: Value, name: str, kind: str, value: Value) -> bpy.types.NodeSocket:
    node = graph.add("GeometryNodeStoreNamedAttribute", data_type=kind, domain="POINT")
    graph.give(node.inputs["Geometry"], geometry)
    graph.give(node.inputs["Name"], name)
    graph.give(node.inputs["Value"], value)
    return node.outputs[0]


def _remove(graph: Graph, geometry: Value, pattern: str) -> bpy.types.NodeSocket:
    node = graph.add("GeometryNodeRemoveAttribute", {"Geometry": geometry, "Name": pattern})
    if "*" in pattern:
        if "Pattern Mode" in node.inputs:  # a menu input since 5.0, a setting of the node before
            node.inputs["Pattern Mode"].default_value = "Wildcard"
        else:
            node.pattern_mode = "WILDCARD"
    return node.outputs[0]


_KINDS = {"QUATERNION": "ROTATION", "FLOAT_VECTOR": "VECTOR", "FLOAT": "FLOAT"}
"""Kinds of attributes, and how nodes that mix and switch call them."""


class _Samples:
    """Attributes `NAME_K` of a sample and the next, blended by the fraction of the sample's number."""

    def __init__(self, graph: Graph, sample: Value) -> None:
        self.graph = graph
        self.lower = graph.math("FLOOR", sample)
        self.fraction = graph.math("SUBTRACT", sample, self.lower)
        self.upper = graph.math("CEIL", sample)

    def _named(self, prefix: str, number: Value) -> bpy.types.NodeSocket:
        graph = self.graph
        text = graph.add("FunctionNodeValueToString", {0: number}).outputs[0]
        join = graph.add("GeometryNodeStringJoin", {"Delimiter": "_"})
        # The last link of a multi-input comes first.
        graph.tree.links.new(text, join.inputs["Strings"])
        graph.tree.links.new(
            graph.add("FunctionNodeInputString", string=prefix).outputs[0], join.inputs["Strings"]
        )
        return join.outputs[0]

    def blended(self, prefix: str, kind: str, rest: Value) -> bpy.types.NodeSocket:
        """The value between two samples; `rest` where there are none."""
        graph = self.graph
        a, exists = graph.attribute(self._named(prefix, self.lower), kind)
        b, _ = graph.attribute(self._named(prefix, self.upper), kind)
        mix = graph.add("ShaderNodeMix", data_type=_KINDS[kind])
        sockets = [socket for socket in mix.inputs if socket.enabled]
        for socket, value in zip(sockets, (self.fraction, a, b), strict=True):
            graph.give(socket, value)
        result = next(socket for socket in mix.outputs if socket.enabled)
        return graph.switch(exists, rest, result, _KINDS[kind])


def _faded(graph: Graph, geometry: Value, sample: Value) -> bpy.types.NodeSocket:
    """The splats with the opacities of a sample; as they are where they do not fade."""
    opacity = _Samples(graph, sample).blended("opacity", "FLOAT", graph.attribute("opacity", "FLOAT")[0])
    return _remove(graph, _store(graph, geometry, "opacity", "FLOAT", opacity), "opacity_*")


def _deformed(graph: Graph, geometry: Value, sample: Value) -> bpy.types.NodeSocket:
    """The splats at a sample; as they are where they do not deform."""
    samples = _Samples(graph, sample)
    place = graph.add("GeometryNodeInputPosition").outputs[0]
    moved = graph.add(
        "GeometryNodeSetPosition",
        {"Geometry": geometry, "Position": samples.blended("position", "FLOAT_VECTOR", place)},
    ).outputs[0]
    for name, kind in (("rot", "QUATERNION"), ("scale", "FLOAT_VECTOR")):
        moved = _store(graph, moved, name, kind, samples.blended(name, kind, graph.attribute(name, kind)[0]))
    for name in ("position", "rot", "scale"):
        moved = _remove(graph, moved, f"{name}_*")
    return moved
