"""Geometry Nodes that put an ellipsoid on every vertex.

Attributes of the mesh: `rot` (quaternion), `scale` (standard deviations), `opacity`, `colour` (linear); `sh_0`
to `sh_15` where the colour depends on the view; `position_K`, `rot_K`, `scale_K` where the splats deform, K
counting the samples.
"""

from __future__ import annotations

import math

import bpy

from . import material
from .graph import Graph, Value

NAME = "CIF splats"
SAMPLE = "Sample"
"""Input that picks the sample of splats that deform; fractions blend two of them."""
BLUR = "Pixel Angle"
"""Input with the angle of one recorded pixel, radians: training blurs splats by `LOW_PASS` pixels^2."""
NEAR = "Near"
"""Input with the depth below which a splat is not drawn, object units."""
DISPLAY = "Display Blending"
"""Input that leaves colours display-referred, to be shown without a view transform."""
LOW_PASS = 0.3
"""Variance of the blur on the image that training adds to every splat, pixels^2."""
SUBDIVISIONS = 2
INRADIUS = 0.9341723589627157
"""Radius of the sphere inside an icosphere of that many subdivisions, see `_inradius` in the tests."""

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
BAND_3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
"""Factors of real spherical harmonics with the Condon-Shortley sign, as 3D Gaussian splatting uses them."""


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
        (BLUR, "NodeSocketFloat", 0.0),
        (NEAR, "NodeSocketFloat", 0.0),
        (DISPLAY, "NodeSocketBool", False),
    ):
        socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        if value is not None:
            socket.default_value = value
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    graph = Graph(tree)
    given = graph.add("NodeGroupInput").outputs

    moved = _deformed(graph, given["Geometry"], given[SAMPLE])
    camera = _Camera(graph)
    scale = _size(graph, camera, given[BLUR], given[NEAR])
    points = _store(graph, moved, material.COLOR, "FLOAT_VECTOR", _color(graph, camera, given[DISPLAY]))
    points = _store(graph, points, material.OPACITY, "FLOAT", graph.attribute("opacity", "FLOAT")[0])
    rotation = graph.attribute("rot", "QUATERNION")[0]
    ball = graph.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0 / INRADIUS, "Subdivisions": SUBDIVISIONS})
    ball = graph.add("GeometryNodeSetMaterial", {0: ball.outputs["Mesh"], 2: material.splat_material()})
    instances = graph.add(
        "GeometryNodeInstanceOnPoints",
        {"Points": points, "Instance": ball.outputs[0], "Rotation": rotation, "Scale": scale},
    ).outputs[0]
    # The shader looks up two attributes of an instance; thousands of copies of the others would be waste.
    for name in ("rot", "scale", "opacity", "colour", "sh_*"):
        instances = _remove(graph, instances, name)
    graph.add("NodeGroupOutput", {0: instances})
    graph.arrange()
    return tree


def set_input(modifier: bpy.types.NodesModifier, name: str, value: float | bool) -> str:
    """Set an input of the modifier by name; its data path in the object, to be animated."""
    identifier = input_identifier(modifier, name)
    modifier[identifier] = value
    return f'modifiers["{modifier.name}"]["{identifier}"]'


def input_identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    """Key of an input in the modifier."""
    items = modifier.node_group.interface.items_tree
    return next(item.identifier for item in items if item.name == name and item.in_out == "INPUT")


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


def _deformed(graph: Graph, geometry: Value, sample: Value) -> bpy.types.NodeSocket:
    """The splats at a sample; as they are where they do not deform."""
    lower = graph.math("FLOOR", sample)
    fraction = graph.math("SUBTRACT", sample, lower)
    upper = graph.math("CEIL", sample)

    def named(prefix: str, number: Value) -> bpy.types.NodeSocket:
        text = graph.add("FunctionNodeValueToString", {0: number}).outputs[0]
        join = graph.add("GeometryNodeStringJoin", {"Delimiter": "_"})
        # The last link of a multi-input comes first.
        graph.tree.links.new(text, join.inputs["Strings"])
        graph.tree.links.new(
            graph.add("FunctionNodeInputString", string=prefix).outputs[0], join.inputs["Strings"]
        )
        return join.outputs[0]

    def blended(prefix: str, kind: str, rest: Value) -> bpy.types.NodeSocket:
        a, exists = graph.attribute(named(prefix, lower), kind)
        b, _ = graph.attribute(named(prefix, upper), kind)
        rotation = kind == "QUATERNION"
        mix = graph.add("ShaderNodeMix", data_type="ROTATION" if rotation else "VECTOR")
        sockets = [socket for socket in mix.inputs if socket.enabled]
        for socket, value in zip(sockets, (fraction, a, b), strict=True):
            graph.give(socket, value)
        result = next(socket for socket in mix.outputs if socket.enabled)
        return graph.switch(exists, rest, result, "ROTATION" if rotation else "VECTOR")

    place = graph.add("GeometryNodeInputPosition").outputs[0]
    moved = graph.add(
        "GeometryNodeSetPosition",
        {"Geometry": geometry, "Position": blended("position", "FLOAT_VECTOR", place)},
    ).outputs[0]
    for name, kind in (("rot", "QUATERNION"), ("scale", "FLOAT_VECTOR")):
        moved = _store(graph, moved, name, kind, blended(name, kind, graph.attribute(name, kind)[0]))
    for name in ("position", "rot", "scale"):
        moved = _remove(graph, moved, f"{name}_*")
    return moved


class _Camera:
    """The scene's camera in the frame of the object."""

    def __init__(self, graph: Graph) -> None:
        active = graph.add("GeometryNodeInputActiveCamera").outputs[0]
        info = graph.add("GeometryNodeObjectInfo", {"Object": active}, transform_space="RELATIVE")
        position = graph.add("GeometryNodeInputPosition").outputs[0]
        inverse = graph.add("FunctionNodeInvertMatrix", {0: info.outputs["Transform"]}).outputs[0]
        seen = graph.add("FunctionNodeTransformPoint", {"Vector": position, "Transform": inverse}).outputs[0]
        depth = graph.add("ShaderNodeSeparateXYZ", {0: seen}).outputs["Z"]
        self.depth = graph.math("MULTIPLY", depth, -1.0)
        """Distance in front of the camera along its axis, negative behind it."""
        offset = graph.vector("SUBTRACT", position, info.outputs["Location"])
        self.direction = graph.vector("NORMALIZE", offset)
        """Unit vector from the camera to the splat."""


def _size(graph: Graph, camera: _Camera, blur: Value, near: Value) -> bpy.types.NodeSocket:
    """Half axes of the ellipsoid, 0 where nothing is seen."""
    opacity = graph.attribute("opacity", "FLOAT")[0]
    # ln(255 opacity) * 2, which is negative where the splat is fainter than one step.
    steps = graph.math("MAXIMUM", graph.math("MULTIPLY", opacity, material.STEPS), 1e-9)
    squared = graph.math("MULTIPLY", graph.math("LOGARITHM", steps, math.e), 2.0)
    # Without a camera, or with the blur turned off, the near limit does not count either.
    trained = graph.add("FunctionNodeCompare", {0: blur, 1: 0.0}, operation="GREATER_THAN").outputs[0]
    close = graph.add("FunctionNodeCompare", {0: camera.depth, 1: near}, operation="LESS_THAN").outputs[0]
    hidden = graph.add("FunctionNodeBooleanMath", {0: trained, 1: close}, operation="AND").outputs[0]
    squared = graph.switch(hidden, squared, 0.0, "FLOAT")
    pixel = graph.math("MULTIPLY", graph.math("MAXIMUM", camera.depth, 0.0), blur)
    variance = graph.math("MULTIPLY", graph.math("MULTIPLY", pixel, pixel), LOW_PASS)
    scale = graph.attribute("scale", "FLOAT_VECTOR")[0]
    widened = graph.vector("ADD", graph.vector("MULTIPLY", scale, scale), variance)
    radius = graph.math("SQRT", graph.math("MAXIMUM", squared, 0.0))
    axes = graph.add("ShaderNodeSeparateXYZ", {0: widened}).outputs
    half = [graph.math("MULTIPLY", graph.math("SQRT", axes[axis]), radius) for axis in range(3)]
    return graph.add("ShaderNodeCombineXYZ", dict(enumerate(half))).outputs[0]


def _color(graph: Graph, camera: _Camera, display: Value) -> bpy.types.NodeSocket:
    """Colour seen from the camera: linear, or display-referred where that is wanted."""
    plain = graph.attribute("colour", "FLOAT_VECTOR")[0]
    first, exists = graph.attribute("sh_0", "FLOAT_VECTOR")
    total = graph.vector("ADD", graph.scaled(first, BAND_0), (0.5, 0.5, 0.5))
    for number, weight in enumerate(_basis(graph, camera.direction), start=1):
        total = graph.vector(
            "ADD", total, graph.scaled(graph.attribute(f"sh_{number}", "FLOAT_VECTOR")[0], weight)
        )
    total = graph.vector("MAXIMUM", total, (0.0, 0.0, 0.0))
    linear = graph.switch(exists, plain, _transfer(graph, total, decode=True), "VECTOR")
    shown = graph.switch(exists, _transfer(graph, plain, decode=False), total, "VECTOR")
    return graph.switch(display, linear, shown, "VECTOR")


def _transfer(graph: Graph, color: Value, decode: bool) -> bpy.types.NodeSocket:
    """The sRGB curve per channel, to linear or back; unclamped. Source: IEC 61966-2-1."""

    def channel(value: Value) -> bpy.types.NodeSocket:
        if decode:
            curved = graph.math("POWER", graph.math("DIVIDE", graph.math("ADD", value, 0.055), 1.055), 2.4)
            straight, low = graph.math("DIVIDE", value, 12.92), 0.04045
        else:
            curved = graph.math(
                "SUBTRACT", graph.math("MULTIPLY", graph.math("POWER", value, 1 / 2.4), 1.055), 0.055
            )
            straight, low = graph.math("MULTIPLY", value, 12.92), 0.0031308
        small = graph.add("FunctionNodeCompare", {0: value, 1: low}, operation="LESS_EQUAL").outputs[0]
        return graph.switch(small, curved, straight, "FLOAT")

    channels = graph.add("ShaderNodeSeparateXYZ", {0: color}).outputs
    return graph.add("ShaderNodeCombineXYZ", {i: channel(channels[i]) for i in range(3)}).outputs[0]


def _basis(graph: Graph, direction: Value) -> list[bpy.types.NodeSocket]:
    """Spherical harmonics of degrees 1 to 3 at a unit direction, in the order of 3D Gaussian splatting."""
    x, y, z = graph.add("ShaderNodeSeparateXYZ", {0: direction}).outputs[:3]

    def times(*factors: Value) -> bpy.types.NodeSocket:
        product = factors[0]
        for factor in factors[1:]:
            product = graph.math("MULTIPLY", product, factor)
        return product

    def plus(a: Value, b: Value) -> bpy.types.NodeSocket:
        return graph.math("ADD", a, b)

    def minus(a: Value, b: Value) -> bpy.types.NodeSocket:
        return graph.math("SUBTRACT", a, b)

    xx, yy, zz = times(x, x), times(y, y), times(z, z)
    five = minus(times(zz, 4.0), plus(xx, yy))  # 4 zz - xx - yy
    flat = minus(xx, yy)
    b2, b3 = BAND_2, BAND_3
    return [
        times(y, -BAND_1),
        times(z, BAND_1),
        times(x, -BAND_1),
        times(x, y, b2[0]),
        times(y, z, b2[1]),
        times(minus(times(zz, 2.0), plus(xx, yy)), b2[2]),
        times(x, z, b2[3]),
        times(flat, b2[4]),
        times(y, minus(times(xx, 3.0), yy), b3[0]),
        times(x, times(y, z), b3[1]),
        times(y, five, b3[2]),
        times(z, minus(times(zz, 2.0), times(plus(xx, yy), 3.0)), b3[3]),
        times(x, five, b3[4]),
        times(z, flat, b3[5]),
        times(x, minus(xx, times(yy, 3.0)), b3[6]),
    ]
