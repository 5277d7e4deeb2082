"""The look of a splat: light that is given off and held back by a Gaussian density.

The surface is the ellipsoid where the density ends; each ray that enters it sees the opacity
`opacity * exp(-d^2 / 2)`, d the least Mahalanobis distance of the ray to the centre. In the frame of the
instance the ellipsoid is the unit sphere and ends at `r = sqrt(2 ln(255 opacity))` standard deviations, where
the opacity falls to 1/255. With q the squared distance of the ray to the origin in that frame, the opacity is
`opacity * (255 opacity)^-q`. Back faces are clear, so that each splat counts once.
"""

from __future__ import annotations

import bpy

from .graph import Graph

NAME = "CIF splats"
COLOR = "splat_color"
OPACITY = "splat_opacity"
STEPS = 255.0
"""Steps of an 8-bit image: fainter than one of them is not drawn, as in training."""
MAX_OPACITY = 0.99
"""Largest opacity of one splat, as in training."""


def splat_material() -> bpy.types.Material:
    """The material, made once per file. Works in Cycles and, dithered, in Eevee."""
    material = bpy.data.materials.get(NAME)
    if material is not None:
        return material
    material = bpy.data.materials.new(NAME)
    if material.node_tree is None:  # before Blender 5
        material.use_nodes = True
    material.surface_render_method = "DITHERED"
    material.use_backface_culling = True
    material.use_transparent_shadow = True
    # Tens of thousands of small lamps would cost more than they light.
    material.cycles.emission_sampling = "NONE"
    material.node_tree.nodes.clear()
    graph = Graph(material.node_tree)

    color = graph.add("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=COLOR)
    opacity = graph.add("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=OPACITY).outputs[
        "Fac"
    ]
    point = graph.add("ShaderNodeTexCoord").outputs["Object"]
    geometry = graph.add("ShaderNodeNewGeometry")
    ray = graph.add(
        "ShaderNodeVectorTransform",
        {0: geometry.outputs["Incoming"]},
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    ).outputs[0]

    along = graph.vector("DOT_PRODUCT", point, ray)
    square = graph.vector("DOT_PRODUCT", point, point)
    length = graph.vector("DOT_PRODUCT", ray, ray)
    distance = graph.math(
        "SUBTRACT", square, graph.math("DIVIDE", graph.math("MULTIPLY", along, along), length)
    )
    distance = graph.math("MAXIMUM", distance, 0.0)
    base = graph.math("MULTIPLY", opacity, STEPS)
    falloff = graph.math("POWER", base, graph.math("MULTIPLY", distance, -1.0))
    alpha = graph.math("MINIMUM", graph.math("MULTIPLY", opacity, falloff), MAX_OPACITY)
    inside = graph.math("LESS_THAN", distance, 1.0)
    front = graph.math("SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    alpha = graph.math("MULTIPLY", alpha, graph.math("MULTIPLY", inside, front))

    clear = graph.add("ShaderNodeBsdfTransparent")
    light = graph.add("ShaderNodeEmission", {"Color": color.outputs["Color"], "Strength": 1.0})
    mix = graph.add("ShaderNodeMixShader", {0: alpha, 1: clear.outputs[0], 2: light.outputs[0]})
    graph.add("ShaderNodeOutputMaterial", {"Surface": mix.outputs[0]})
    graph.arrange()
    return material
