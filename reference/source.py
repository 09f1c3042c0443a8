"""What stands in the sources of the suite, read without running them."""

import ast
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parent.parent


def modules(rooms: Sequence[str]) -> Iterator[tuple[Path, ast.Module]]:
    """Path and tree of every module of these rooms."""
    for room in rooms:
        for path in sorted((ROOT / room).rglob("*.py")):
            yield path, ast.parse(path.read_text(encoding="utf-8"))


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Every function and method."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def literal(node: ast.expr) -> str | None:
    """A string as it stands there; of an f-string, with a word in capitals for each value."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else ast.unparse(part).strip("f'{}").upper()
            for part in node.values
        )
    return None


def keys_of(value: ast.expr, function: ast.FunctionDef, tree: ast.Module) -> set[str] | None:
    """The keys of a dict that is written down in this function, or in one of its module; None where it is not."""
    if isinstance(value, ast.Dict):
        keys: set[str] = set()
        for key, inner in zip(value.keys, value.values, strict=True):
            more = keys_of(inner, function, tree) if key is None else {literal(key) or ""}
            keys |= more or set()
        return keys
    if isinstance(value, ast.Name):
        return _of_name(value.id, function, tree)
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        called = next((each for each in functions(tree) if each.name == value.func.id), None)
        returned = [node.value for node in ast.walk(called or ast.Module([], [])) if isinstance(node, ast.Return)]
        if called is not None and returned and returned[0] is not None:
            return keys_of(returned[0], called, tree)
    return None


def _of_name(name: str, function: ast.FunctionDef, tree: ast.Module) -> set[str] | None:
    keys: set[str] | None = None
    for node in ast.walk(function):
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = getattr(node, "value", None)
        if not isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) or value is None:
            continue
        if isinstance(target, ast.Name) and target.id == name:
            found = keys_of(value, function, tree)
            keys = found if keys is None else keys | (found or set())
        elif isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name) and target.value.id == name:
            keys = (keys or set()) | {literal(target.slice) or ""}
    return keys
