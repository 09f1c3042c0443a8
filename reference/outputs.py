"""The page about what `--json FILE` writes, command by command."""

import ast
from collections.abc import Mapping
from dataclasses import fields
from typing import Final

from cli.compare import Comparison
from cli.config import StudyTable
from drivers.discovery import FoundDevice
from milling.replay import Difference, Replay
from milling.result import RunResult
from reference.source import functions, keys_of, literal, modules

HEAD: Final = """\
# JSON results

`--json FILE` writes one object, whatever the exit code, as long as the work itself was done; `--json -` writes it to
stdout, and what people read goes to stderr. Units are in the names, numbers are finite, and what is not known is
null. These keys are the same everywhere:

| key | what it is |
|---|---|
| `schema` | 1; it grows when a key changes its meaning |
| `command` | which command wrote it |
| `version` | of mill |
| `seed` | what drew specimen and rig of a virtual bench; null on hardware, and where nothing is drawn |

"""

_RUN: Final = {
    "outcome": '"complete", "held" or "aborted"',
    "reason": "why, in words",
    "milling_time_s": "from the first lap to the end, looks included",
    "laps": "how many times round",
    "points": "one object per point of the ring, in their order: `depth_mm` below contact, `completion` and its bound "
    "`upper`, `contact_mm`, `load_ratio`, `left_probability`, `state`, `why`, and how often which `permissions` were "
    "given or withheld",
    "center_mm": "of the milled ring, in {R}",
    "radius_mm": "of the milled ring",
    "record": "folder of the record",
    "report": "the page about it",
    "truth": "what a virtual bench knows: `membrane_touched`, `flap_free`, `success`, `max_overrun_mm`, "
    "`completion_rmse`; absent on hardware",
}
_CALIBRATE: Final = {
    "file": "the calibration file",
    "report": "the page about it",
    "recipe": '"default" or "paper"',
    "model": "of the models that were tried, the one with the smallest held-out error",
    "candidates_mm": "the held-out error of each model",
    "handedness": '"right-handed"; a mirrored fit is refused',
    "not_for_milling": "true for the recipe of the paper",
    "rmse_mm": "held-out error: each setpoint told by a fit to the others",
    "predicted_rmse_mm": "what the calibration's own covariance predicts over the box",
    "residuals_mm": "of each setpoint",
    "setpoints": "where the drill stood, in {R}",
    "duration_s": "homing included",
    "truth": "on a virtual bench: errors at 20 places of the box that were no setpoints; absent on hardware",
    "error_mm": "`--verify`: the place seen less the place told",
    "sigma_mm": "`--verify`: one standard deviation of that",
    "error_px": "`--verify`: the same in the pictures",
    "distance_sigmas": "`--verify`: error by its own covariance; above 4.5 it is refused",
}

WORDS: Final[dict[str, dict[str, str]]] = {
    "calibrate": _CALIBRATE,
    "run": _RUN,
    "devices": {
        "devices": "what was found: " + ", ".join(f"`{field.name}`" for field in fields(FoundDevice)) + "; with "
        "`--identify` also `identified`, with `--pictures` also `picture`",
        "changes": "with `--watch`: what was plugged in or pulled, and when",
    },
    "doctor": {
        "passed": "whether every check passed",
        "checks": "one object each: `name`, `value`, `unit`, `limit`, `verdict` (pass or fail), and `advice` where "
        "one failed",
        "report": "the page about it",
        "certificate": "the certificate, if it was given",
    },
    "experiment NAME": {
        "recipes": "names of the recipes; each is a key of its own, with its figures and their intervals",
        "asked": "which recipes were asked for",
        "published": "the paper's figures, which are no simulation",
        "trials": "one object per specimen and recipe",
    },
    "evaluate TASK": {
        "weights_sha256": "of the network",
        "duration_s": "of the measurement; beside it stand the task's figures, each under its name, "
        "with the ends of its interval where there is one",
    },
    "runs list": {
        "runs": "one object per record: `run`, `outcome`, `reason`, `rig`, `milling_time_s`, `labels`, and the "
        "study's `specimen_id`, `protocol`, `operator`"
    },
    "runs show": {
        "header": "the record's header",
        "rig": "its rig",
        "outcome": _RUN["outcome"] + '; "cut off" where the process ended first',
        "reason": _RUN["reason"],
        "milling_time_s": _RUN["milling_time_s"],
        "points": "as of `mill run`",
        "damage": "what of the record was lost, in words; null where nothing was",
        "specimen_id": "as told on the command line or in the rig file; null where nobody told",
        "protocol": "likewise",
        "operator": "likewise",
        "chain": "`lines` of the events and the last one's link, `head`; null in records of before",
        "labels": "every label in the order it was told: `date`, `by`, `name`, `value`",
    },
    "runs verify": {
        "runs": "one object per record: `run`, `state` (whole, changed, cut off, no chain), `reasons`, `chain` and how "
        "many `files` are as the events tell",
    },
    "runs compare": {
        "a": "the first record",
        "b": "the second one",
        "page": "the page about both",
        "set_up": "what they were given differently: `what`, `a` and `b` as texts",
        "outcome": "what came of it, likewise, whether it differs or not",
        "decisions": "how often a bite was asked for, by the answer: `answer`, `a`, `b`",
    },
    "runs replay": {
        "run": "the record",
        "weights": "what else read its pictures",
        "policy": "what else decided",
        "asked": "decisions",
        "readings": "pictures of the ring",
        "without_picture": "readings whose picture was not kept; with other weights they are left out on both sides",
        "differences": "every visit that was decided otherwise: "
        + ", ".join(f"`{field.name}`" for field in fields(Difference)),
    },
}
"""By command, what each key is."""

SAME_AS: Final = {"resume": "run"}

_ELSEWHERE: Final[Mapping[tuple[str, str], set[str]]] = {
    ("run", "result.to_json()"): {field.name for field in fields(RunResult)},
    ("runs replay", "told"): {field.name for field in fields(Replay)},
    ("runs show", "facts"): {"rig", "outcome", "reason", "milling_time_s", *StudyTable.model_fields},
    ("runs compare", "asdict(comparison)"): {field.name for field in fields(Comparison)},
    ("experiment NAME", "recipes"): set(),
    ("evaluate TASK", "{name: value if math.isfinite(value) else None for name, value in figures.items()}"): set(),
    (
        "evaluate TASK",
        "{f'{name}_{end}': value for name, both in intervals.items() for end, value in zip(ENDS, both, strict=True)}",
    ): set(),
}
"""What stands behind `**` where the dict is made in another place: by command and expression."""


def written() -> dict[str, set[str]]:
    """By command, the keys that the sources write.

    Raises:
        ValueError: a dict whose keys are not to be seen in the source; say them in ``_ELSEWHERE``.
    """
    commands: dict[str, set[str]] = {}
    for path, tree in modules(["cli"]):
        for function in functions(tree):
            for call in ast.walk(function):
                if not (isinstance(call, ast.Call) and ast.unparse(call.func) == "write_json"):
                    continue
                # `mill run` and `mill resume` share one function, which is told its command.
                command = literal(call.args[1]) or "run"
                keys = commands.setdefault(command, set())
                for keyword in call.keywords:
                    if keyword.arg is not None:
                        keys.add(keyword.arg)
                        continue
                    keys |= _behind(keyword.value, command, function, tree, str(path.name))
    return {command: keys - {"seed"} for command, keys in commands.items()}


def _behind(value: ast.expr, command: str, function: ast.FunctionDef, tree: ast.Module, where: str) -> set[str]:
    known = _ELSEWHERE.get((command, ast.unparse(value)))
    if known is not None:
        return known
    keys = keys_of(value, function, tree)
    if keys is None:
        raise ValueError(f"{where}: what does **{ast.unparse(value)} hold? say it in reference/outputs.py")
    inner = {source: more for (of, source), more in _ELSEWHERE.items() if of == command}
    return keys.union(*(more for source, more in inner.items() if f"**{source}" in ast.unparse(function)))


def page() -> str:
    """One table per command; a key without words is listed all the same."""
    parts = [HEAD]
    found = written()
    for command in sorted(found):
        said = WORDS.get(command, {})
        names = [command, *(other for other, of in SAME_AS.items() if of == command)]
        parts.append("## " + ", ".join(f"mill {name}" for name in names) + "\n\n| key | what it is |\n|---|---|\n")
        order = [key for key in said if key in found[command]] + sorted(found[command] - said.keys())
        parts += [f"| `{key}` | {said.get(key, '')} |\n" for key in order]
        parts.append("\n")
    return "".join(parts)
