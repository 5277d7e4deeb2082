"""Node trees written as expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import bpy

Value = bpy.types.NodeSocket | float | bool | int | str | tuple[float, ...]
"""What an input of a node can be given: an output to link, or a constant."""


class Graph:
    """Adds nodes to a tree and links them."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(
        self, kind: str, inputs: Mapping[int | str, Value] | None = None, **settings: object
    ) -> bpy.types.Node:
        """A node of a type with settings, its inputs linked or set by name or place."""
        node = self.tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            self.give(node.inputs[key], value)
        return node

    def give(self, target: bpy.types.NodeSocket, value: Value) -> None:
        """Link an output to an input, or set its constant."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, target)
        else:
            target.default_value = value

    def math(self, operation: str, a: Value, b: Value = 0.0) -> bpy.types.NodeSocket:
        """A scalar operation; available in shaders and geometry."""
        return self.add("ShaderNodeMath", {0: a, 1: b}, operation=operation).outputs[0]

    def vector(self, operation: str, a: Value, b: Value = (0.0, 0.0, 0.0)) -> bpy.types.NodeSocket:
        """A vector operation; the result is a scalar for DOT_PRODUCT and LENGTH."""
        node = self.add("ShaderNodeVectorMath", {0: a, 1: b}, operation=operation)
        return node.outputs["Value" if operation in ("DOT_PRODUCT", "LENGTH", "DISTANCE") else "Vector"]

    def scaled(self, vector: Value, factor: Value) -> bpy.types.NodeSocket:
        """A vector times a scalar."""
        return self.add("ShaderNodeVectorMath", {0: vector, "Scale": factor}, operation="SCALE").outputs[
            "Vector"
        ]

    def total(self, terms: Sequence[Value]) -> bpy.types.NodeSocket:
        """Sum of scalars."""
        result = terms[0]
        for term in terms[1:]:
            result = self.math("ADD", result, term)
        return result

    def clamped(self, value: Value, bound: Value) -> bpy.types.NodeSocket:
        """A scalar held between -bound and bound."""
        return self.math("MAXIMUM", self.math("MINIMUM", value, bound), self.math("MULTIPLY", bound, -1.0))

    def compare(self, operation: str, a: Value, b: Value) -> bpy.types.NodeSocket:
        """A comparison of scalars."""
        return self.add("FunctionNodeCompare", {0: a, 1: b}, operation=operation).outputs[0]

    def attribute(self, name: Value, kind: str) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """A named attribute and whether it exists."""
        node = self.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind)
        return node.outputs["Attribute"], node.outputs["Exists"]

    def switch(self, condition: Value, no: Value, yes: Value, kind: str) -> bpy.types.NodeSocket:
        """`yes` where the condition holds, else `no`."""
        return self.add(
            "GeometryNodeSwitch", {"Switch": condition, "False": no, "True": yes}, input_type=kind
        ).outputs[0]

    def arrange(self) -> None:
        """Put the nodes into columns by their distance from the inputs, so that the tree can be read."""
        depth: dict[str, int] = {}

        def column(node: bpy.types.Node) -> int:
            if node.name not in depth:
                depth[node.name] = 0
                before = [link.from_node for socket in node.inputs for link in socket.links]
                depth[node.name] = 1 + max((column(other) for other in before), default=-1)
            return depth[node.name]

        rows: dict[int, int] = {}
        for node in self.tree.nodes:
            place = column(node)
            node.location = (220 * place, -180 * rows.get(place, 0))
            rows[place] = rows.get(place, 0) + 1
