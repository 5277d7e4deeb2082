"""Colour of every splat, seen from the camera."""

from __future__ import annotations

import bpy

from .graph import Graph, Value
from .shape_nodes import Camera

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


def color(graph: Graph, camera: Camera, tint: Value, display: Value) -> bpy.types.NodeSocket:
    """Colour seen from the camera, tinted: linear, or display-referred where that is wanted."""
    plain = graph.attribute("colour", "FLOAT_VECTOR")[0]
    first, exists = graph.attribute("sh_0", "FLOAT_VECTOR")
    total = graph.vector("ADD", graph.scaled(first, BAND_0), (0.5, 0.5, 0.5))
    for number, weight in enumerate(_basis(graph, camera.direction), start=1):
        total = graph.vector(
            "ADD", total, graph.scaled(graph.attribute(f"sh_{number}", "FLOAT_VECTOR")[0], weight)
        )
    total = graph.vector("MAXIMUM", total, (0.0, 0.0, 0.0))
    linear = graph.switch(exists, plain, _transfer(graph, total, decode=True), "VECTOR")
    linear = graph.vector("MULTIPLY", linear, tint)
    return graph.switch(display, linear, _transfer(graph, linear, decode=False), "VECTOR")


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
