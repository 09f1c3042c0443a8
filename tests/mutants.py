"""Are the tests of the safety rules worth anything? Change one thing in the rules at a time: does a test fall?

    python tests/mutants.py [MODULE ...]

prints every change that no test noticed; docs/mutants.md says of each why it does not matter. A change is one swapped
comparison, one condition taken for its contrary, one number or sign, one statement left out.
"""

import ast
import contextlib
import copy
import importlib
import os
import signal
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
RULES = "tests/milling/test_rules.py"
MUTATED = {
    "milling.point": RULES,
    "milling.permission": RULES,
    "milling.supervisor": "tests/milling/supervising",
}
"""And the tests that must notice."""
TIMEOUT_S = 20

COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Mod: ast.Mult}
CALLED = {"min": "max", "max": "min", "any": "all", "all": "any"}


def variants(node: ast.AST) -> Iterator[tuple[str, ast.AST | None]]:
    """What one node may be changed to, and in which words; None leaves a statement out."""
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            if type(operator) in COMPARED:
                other = copy.deepcopy(node)
                other.ops[place] = COMPARED[type(operator)]()
                yield "comparison", other
    elif isinstance(node, ast.BoolOp):
        for place in range(len(node.values)):
            rest = [value for at, value in enumerate(node.values) if at != place]
            yield "a condition less", rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        yield "arithmetic", ast.BinOp(node.left, COMPUTED[type(node.op)](), node.right)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "not", node.operand
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CALLED:
        yield "call", ast.Call(ast.Name(CALLED[node.func.id], ast.Load()), node.args, node.keywords)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield "constant", ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield "constant", ast.Constant(node.value + 1)
    elif isinstance(node, ast.IfExp):
        yield "contrary", ast.IfExp(node.test, node.orelse, node.body)
    elif isinstance(node, ast.If):
        yield "contrary", ast.If(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
    if isinstance(node, ast.Assign | ast.AugAssign) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ):
        yield "left out", None


def mutants(source: str) -> Iterator[tuple[int, str, ast.Module]]:
    """Line, words and tree of every change inside a function."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    spots = [node for function in functions for statement in function.body for node in ast.walk(statement)]
    for spot in spots:
        for words, other in variants(spot):
            was = ast.unparse(spot).splitlines()[0]
            now = "nothing" if other is None else ast.unparse(ast.fix_missing_locations(other)).splitlines()[0]
            changed = _Swap(spot, copy.deepcopy(other)).visit(ast.parse(source))
            yield spot.lineno, f"{words}: {was} -> {now}", ast.fix_missing_locations(changed)


class _Swap(ast.NodeTransformer):
    def __init__(self, spot: ast.AST, other: ast.AST | None) -> None:
        self._spot, self._other = spot, other

    def visit(self, node: ast.AST) -> ast.AST:
        same = type(node) is type(self._spot) and all(
            getattr(node, place, None) == getattr(self._spot, place, None)
            for place in ("lineno", "col_offset", "end_lineno", "end_col_offset")
        )
        if same:
            return ast.copy_location(ast.Pass() if self._other is None else self._other, node)
        return self.generic_visit(node)


def survives(name: str, tests: str, tree: ast.Module) -> bool:
    """Whether the tests pass in a process of their own in which the module is ``tree``."""
    child = os.fork()
    if child == 0:
        with Path(os.devnull).open("w") as quiet, contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
            signal.alarm(TIMEOUT_S)
            package, _, leaf = name.rpartition(".")
            module = types.ModuleType(name)
            module.__file__ = str(ROOT / package / f"{leaf}.py")
            sys.modules[name] = module
            setattr(importlib.import_module(package), leaf, module)
            code = 1
            with contextlib.suppress(BaseException):
                exec(compile(tree, module.__file__, "exec"), module.__dict__)
                code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", tests]))
        os._exit(min(code, 255))
    return os.waitpid(child, 0)[1] == 0


def main() -> None:
    """Try them all."""
    os.chdir(ROOT)
    total, left = 0, []
    chosen = sys.argv[1:] or list(MUTATED)
    for name in chosen:
        tests = MUTATED[name]
        file = ROOT / (name.replace(".", "/") + ".py")
        for line, words, tree in mutants(file.read_text()):
            total += 1
            if survives(name, tests, tree):
                left.append(f"{file.name}:{line}  {words}")
                print(left[-1], flush=True)
    print(f"{total} changes, {len(left)} that no test noticed")


if __name__ == "__main__":
    main()
