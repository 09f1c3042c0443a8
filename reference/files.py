"""The pages about the files that a person writes: their tables and keys, from the models that check them."""

import ast
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import pairwise
from typing import Any, Final

from pydantic import BaseModel

from cli import config
from firmware_sim import specimen
from milling.job import RANGES, Job

RIG_HEAD: Final = """\
# Rig file: every key

TOML. An unknown key is refused by its name, a value out of range with what is allowed. [The rig file](../rig.md)
shows a whole one, with comments. What has no default must be given.

"""
SPECIMEN_HEAD: Final = """\
# Specimen file: every key

TOML. Every key is optional: what a file does not name, `--seed` draws, or else the default stands. [The specimen
file](../specimen.md) shows a whole one, and its conventions.

"""
_COLUMNS: Final = "| key | kind | default | allowed | what it is |\n|---|---|---|---|---|\n"


def rig_page() -> str:
    """Of ``cli.config`` and ``milling.job``."""
    parts = [RIG_HEAD, _section("The file itself", config.RigConfig, skip_tables=True)]
    for kind, models in config.BUILT_IN.items():
        parts += [_section(f'[{kind}] backend = "{name}"', model) for name, model in models.items()]
    for name, field in config.RigConfig.model_fields.items():
        model = field.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):
            parts.append(_section(f"[{name}]", model))
    return "".join([*parts, _job()])


def specimen_page() -> str:
    """Of ``firmware_sim.specimen``."""
    parts = [SPECIMEN_HEAD, _section("The file itself", specimen.Specimen, skip_tables=True)]
    for name, field in specimen.Specimen.model_fields.items():
        model = field.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):
            parts.append(_section(f"[{name}]", model))
    return "".join(parts)


def meanings(model: type) -> dict[str, str]:
    """What the class says of each attribute, in the string under it."""
    said = {"backend": "Which driver reads this table."}
    for parent in reversed([each for each in model.__mro__ if each.__module__ == model.__module__]):
        (tree,) = ast.parse(inspect.getsource(parent)).body
        assert isinstance(tree, ast.ClassDef)
        for statement, below in pairwise(tree.body):
            if (
                isinstance(statement, ast.AnnAssign)
                and isinstance(statement.target, ast.Name)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                said[statement.target.id] = " ".join(str(below.value.value).split())
    return said


def undocumented(model: type[BaseModel], skip_tables: bool = False) -> list[str]:
    """The keys of which nothing is said."""
    return [row[0] for row in _rows(model, skip_tables) if not row[-1]]


def _section(title: str, model: type[BaseModel], skip_tables: bool = False) -> str:
    about = " ".join((inspect.getdoc(model) or "").split())
    rows = "".join(f"| {' | '.join(row)} |\n" for row in _rows(model, skip_tables))
    return f"## {title}\n\n{about}\n\n{_COLUMNS}{rows}\n"


def _rows(model: type[BaseModel], skip_tables: bool, prefix: str = "") -> Iterator[tuple[str, str, str, str, str]]:
    said = meanings(model)
    schema = model.model_json_schema()
    for name, field in model.model_fields.items():
        key, inner = field.alias or name, field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            if not skip_tables:
                yield from _rows(inner, skip_tables, f"{prefix}{key}.")
            continue
        if skip_tables and _is_table(schema["properties"][key]):
            continue
        kind, allowed = _kind(schema["properties"][key])
        default = "" if field.is_required() or key == "backend" else _value(field.default)
        allowed = allowed if key != "backend" else _value(field.default)
        yield f"`{prefix}{key}`", kind, default, allowed, said.get(name, "").replace("|", "\\|")


def _is_table(schema: Mapping[str, Any]) -> bool:
    return any("$ref" in option for option in [schema, *schema.get("anyOf", [])]) or schema.get("type") == "object"


def _kind(schema: Mapping[str, Any]) -> tuple[str, str]:
    """The kind of value and what is allowed, in words."""
    if "anyOf" in schema:
        (schema,) = (option for option in schema["anyOf"] if option.get("type") != "null")
    if "enum" in schema:
        return "one of", ", ".join(map(_value, schema["enum"]))
    if "const" in schema:
        return "one of", _value(schema["const"])
    if schema.get("type") == "array":
        each, _ = _kind(schema["prefixItems"][0])
        return f"{len(schema['prefixItems'])} {each}s", ""
    if schema.get("type") == "object":
        return "table", ""
    kinds = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
    return ("path" if schema.get("format") == "path" else kinds[schema["type"]]), _range(schema)


def _range(schema: Mapping[str, Any]) -> str:
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{low:g} to {high:g}"
    words = {"at least": low, "above": above, "at most": high, "below": below}
    return ", ".join(f"{word} {value:g}" for word, value in words.items() if value is not None)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        return f'"{value}"' if value else "none"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None or value == {} else str(value)


def _job() -> str:
    said = {
        name: " ".join(words.split())
        for names, words in re.findall(r"^    ([a-z0-9_, ]+): (.*(?:\n      .*)*)", inspect.getdoc(Job) or "", re.M)
        for name in names.split(", ")
    }
    rows = ""
    for field in fields(Job):
        low_high = RANGES.get(field.name)
        allowed = "" if low_high is None else f"{low_high[0]:g} to {low_high[1]:g}"
        kind = "whole number" if field.type is int else "number"
        if field.name == "center_mm":
            kind = "3 numbers"
        elif field.name == "policy":
            kind, allowed = "one of", '"default", "paper", "previous"'
        words = said[field.name].replace("``", "`")
        rows += f"| `{field.name}` | {kind} | {_value(field.default)} | {allowed} | {words[:1].upper()}{words[1:]} |\n"
    about = (
        "The window. `mill run` says otherwise for one run: [`--radius`, `--feed`, `--points`](commands.md#mill-run)."
    )
    return f"## [job]\n\n{about}\n\n{_COLUMNS}{rows}\n"
