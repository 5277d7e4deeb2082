"""Shape of every splat: an ellipsoid, or what a camera sees of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import bpy

from . import material
from .graph import Graph, Value

Socket = bpy.types.NodeSocket

LOW_PASS = 0.3
"""Variance of the blur on the image that training adds to every splat, pixels^2."""
MARGIN = 1.3
"""Where the local affine approximation is held, half image sizes from the centre, as in training."""
THIN = 1e-3
"""Third axis of a disc: thin enough that rays see its plane alone, and still invertible."""


class Camera:
    """The scene's camera in the frame of the object."""

    def __init__(self, graph: Graph) -> None:
        active = graph.add("GeometryNodeInputActiveCamera").outputs[0]
        info = graph.add("GeometryNodeObjectInfo", {"Object": active}, transform_space="RELATIVE")
        position = graph.add("GeometryNodeInputPosition").outputs[0]
        self.matrix: Socket = info.outputs["Transform"]
        """Frame of the camera, in that of the object."""
        self.inverse: Socket = graph.add("FunctionNodeInvertMatrix", {0: self.matrix}).outputs[0]
        seen = graph.add("FunctionNodeTransformPoint", {"Vector": position, "Transform": self.inverse})
        self.x, self.y, self.z = graph.add("ShaderNodeSeparateXYZ", {0: seen.outputs[0]}).outputs[:3]
        self.depth: Socket = graph.math("MULTIPLY", self.z, -1.0)
        """Distance in front of the camera along its axis, negative behind it."""
        offset = graph.vector("SUBTRACT", position, info.outputs["Location"])
        self.direction: Socket = graph.vector("NORMALIZE", offset)
        """Unit vector from the camera to the splat."""


@dataclass(frozen=True)
class Lens:
    """What training knew of the camera; inputs of the group."""

    pixel_angle: Socket
    """Angle of one pixel, radians; 0 turns the blur and the near limit off."""
    view: Socket
    """Half size of the image over the focal length, (x, y, 0)."""
    near: Socket
    """Depth below which nothing is drawn."""


class Shape:
    """Sizes that ellipsoid and disc share."""

    def __init__(self, graph: Graph, camera: Camera, lens: Lens) -> None:
        self.graph, self.camera, self.lens = graph, camera, lens
        opacity = graph.attribute("opacity", "FLOAT")[0]
        # Squared radius at which the opacity falls below one step: 2 ln(255 opacity), negative if never above.
        steps = graph.math("MAXIMUM", graph.math("MULTIPLY", opacity, material.STEPS), 1e-9)
        squared = graph.math("MULTIPLY", graph.math("LOGARITHM", steps, math.e), 2.0)
        trained = graph.compare("GREATER_THAN", lens.pixel_angle, 0.0)
        close = graph.compare("LESS_THAN", camera.depth, lens.near)
        hidden = graph.add("FunctionNodeBooleanMath", {0: trained, 1: close}, operation="AND").outputs[0]
        squared = graph.switch(hidden, squared, 0.0, "FLOAT")
        self.radius = graph.math("SQRT", graph.math("MAXIMUM", squared, 0.0))
        """Radius in standard deviations; 0 where nothing is seen."""
        pixel = graph.math("MULTIPLY", graph.math("MAXIMUM", camera.depth, 0.0), lens.pixel_angle)
        self.variance = graph.math("MULTIPLY", graph.math("MULTIPLY", pixel, pixel), LOW_PASS)
        """Variance of the blur at the depth of the splat."""
        self.position = graph.add("GeometryNodeInputPosition").outputs[0]
        self.rotation = graph.attribute("rot", "QUATERNION")[0]
        self.scale = graph.attribute("scale", "FLOAT_VECTOR")[0]

    def ellipsoid(self) -> Socket:
        """Matrix that makes the unit sphere the ellipsoid."""
        graph = self.graph
        widened = graph.vector("ADD", graph.vector("MULTIPLY", self.scale, self.scale), self.variance)
        axes = graph.add("ShaderNodeSeparateXYZ", {0: widened}).outputs
        half = [graph.math("MULTIPLY", graph.math("SQRT", axes[axis]), self.radius) for axis in range(3)]
        scale = graph.add("ShaderNodeCombineXYZ", dict(enumerate(half))).outputs[0]
        return graph.add(
            "FunctionNodeCombineTransform",
            {"Translation": self.position, "Rotation": self.rotation, "Scale": scale},
        ).outputs[0]

    def disc(self) -> Socket:
        """Matrix that makes the unit disc what the camera sees: the projection, at the depth of the centre.

        Elliptical weighted averaging by the local affine approximation, as in training. Source: EWA splatting
        (Zwicker et al. 2001), in units of the plane through the centre that is parallel to the image.
        """
        graph, camera = self.graph, self.camera
        limit = graph.add("ShaderNodeSeparateXYZ", {0: graph.scaled(self.lens.view, MARGIN)}).outputs
        slopes = [
            graph.clamped(graph.math("DIVIDE", place, camera.z), bound)
            for place, bound in ((camera.x, limit[0]), (camera.y, limit[1]))
        ]
        rows: list[tuple[Socket, Socket]] = []
        deviations = graph.add("ShaderNodeSeparateXYZ", {0: self.scale}).outputs
        for axis in range(3):
            unit = tuple(float(axis == other) for other in range(3))
            turned = graph.add("FunctionNodeRotateVector", {0: unit, 1: self.rotation}).outputs[0]
            own = graph.scaled(turned, deviations[axis])
            seen = graph.add("FunctionNodeTransformDirection", {"Direction": own, "Transform": camera.inverse})
            x, y, z = graph.add("ShaderNodeSeparateXYZ", {0: seen.outputs[0]}).outputs[:3]
            rows.append(
                (
                    graph.math("SUBTRACT", x, graph.math("MULTIPLY", slopes[0], z)),
                    graph.math("SUBTRACT", y, graph.math("MULTIPLY", slopes[1], z)),
                )
            )
        xx = graph.total([self.variance, *(graph.math("MULTIPLY", u, u) for u, _ in rows)])
        xy = graph.total([graph.math("MULTIPLY", u, v) for u, v in rows])
        yy = graph.total([self.variance, *(graph.math("MULTIPLY", v, v) for _, v in rows)])
        # Cholesky factor of the covariance: columns (a, b) and (0, c).
        a = graph.math("MAXIMUM", graph.math("SQRT", xx), 1e-9)
        b = graph.math("DIVIDE", xy, a)
        c = graph.math("SUBTRACT", yy, graph.math("MULTIPLY", b, b))
        c = graph.math("MAXIMUM", graph.math("SQRT", graph.math("MAXIMUM", c, 0.0)), 1e-9)
        columns = [(a, b, 0.0), (0.0, c, 0.0), (0.0, 0.0, graph.math("MULTIPLY", a, THIN))]
        entries: dict[int | str, Value] = {}
        for place, column in enumerate(columns):
            vector = graph.add("ShaderNodeCombineXYZ", dict(enumerate(column))).outputs[0]
            sized = graph.scaled(vector, self.radius)
            own = graph.add("FunctionNodeTransformDirection", {"Direction": sized, "Transform": camera.matrix})
            entries |= _column(graph, place, own.outputs[0])
        entries |= _column(graph, 3, self.position)
        return graph.add("FunctionNodeCombineMatrix", entries).outputs[0]


def _column(graph: Graph, place: int, vector: Value) -> dict[int | str, Value]:
    """Inputs of a Combine Matrix node for one column; the node lists entries column by column."""
    separate = graph.add("ShaderNodeSeparateXYZ", {0: vector}).outputs
    return {4 * place + row: separate[row] for row in range(3)}
