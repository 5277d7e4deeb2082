"""Docstrings of `python/cif/_native.pyi`, taken from the built module, where the doc comments in Rust put them.

    python crates/cif-python/stubs.py        # `make stubs`: after `make test-wheel`, with its Python

The stub holds the types; what things are is written once, in Rust.
"""

from __future__ import annotations

import ast
import inspect
import sys
from pathlib import Path
from types import ModuleType

STUB = Path(__file__).parent / "python" / "cif" / "_native.pyi"


def public(module: ModuleType) -> dict[str, object]:
    """Return everything that the module shows, `Class.member` for members."""
    found = {}
    for name, value in vars(module).items():
        if name.startswith("_"):
            continue
        found[name] = value
        if inspect.isclass(value) and not issubclass(value, Exception):
            members = [member for member in vars(value) if not member.startswith("_")]
            found |= {f"{name}.{member}": vars(value)[member] for member in members}
    return found


def documented(tree: ast.Module, module: ModuleType) -> dict[str, ast.ClassDef | ast.FunctionDef]:
    """Return classes and functions of the stub that the module has too, by name."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.ClassDef) and hasattr(module, node.name):
            found[node.name] = node
            functions = [member for member in node.body if isinstance(member, ast.FunctionDef)]
            members = [member for member in functions if not member.name.startswith("_")]
            found |= {f"{node.name}.{member.name}": member for member in members}
    return found


def words(value: object) -> str:
    """Return the docstring of a function, also of a static method, a class or an attribute."""
    return inspect.cleandoc(getattr(value, "__func__", value).__doc__ or "")


def docstring(text: str, indent: int) -> list[str]:
    """Return the lines of a docstring."""
    space = " " * indent
    lines = [space + line if line else "" for line in text.split("\n")]
    lines[0] = f'{space}"""{text.split(chr(10))[0]}'
    if len(lines) == 1:
        return [lines[0] + '"""']
    return [*lines, f'{space}"""']


def with_docs(stub: str, module: ModuleType) -> str:
    """Return the stub with the docstrings of the module."""
    lines = stub.split("\n")
    nodes = documented(ast.parse(stub), module)
    things = public(module)
    # From the end, so that line numbers hold.
    for name, node in sorted(nodes.items(), key=lambda entry: -entry[1].lineno):
        text = words(things[name])
        first = node.body[0]
        new = docstring(text, node.col_offset + 4)
        before = lines[first.lineno - 1][: first.col_offset]
        if before.strip():
            # `def width(self) -> int: ...`
            new.insert(0, before.rstrip())
        # A docstring, or the dots in its place, goes; anything else stays below it.
        is_replaced = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
        lines[first.lineno - 1 : first.end_lineno if is_replaced else first.lineno - 1] = new
    return "\n".join(lines)


if __name__ == "__main__":
    from cif import _native

    STUB.write_text(with_docs(STUB.read_text(), _native))
    sys.stdout.write(f"wrote {STUB}\n")
