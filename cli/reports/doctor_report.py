"""One examination as one page: verdict, what failed and what to do, then every figure beside its limit."""

import re
from collections.abc import Sequence
from datetime import datetime
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from cli.reports.template import filled
from doctor.certificate import Certificate
from doctor.check import Check

NEAREST = 8
"""Figures in the picture."""
PAPER = {"eyes: error of a fresh calibration": "0.77 mm RMSE in its box"}
"""What the paper has beside a check: it measured no latencies and no wear."""


def write_doctor_report(
    path: Path,
    rig: str,
    checks: Sequence[Check],
    devices: tuple[str, str, str],
    earlier: Certificate | None,
    now: datetime,
    *,
    certified: bool,
) -> None:
    """Write a self-contained page to ``path``."""
    rows = [_row(check, earlier) for check in checks]
    limited = [row for row in rows if row["share"] is not None]
    page = filled(
        "doctor_report.html",
        rig=rig,
        date=now.isoformat(timespec="seconds"),
        devices=devices,
        earlier=earlier,
        certified=certified,
        failed=[row for row in rows if not row["passed"]],
        nearest=sorted(limited, key=itemgetter("share"), reverse=True)[:NEAREST],
        count=len(checks),
        groups={group: list(found) for group, found in groupby(rows, itemgetter("group"))},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")


def _row(check: Check, earlier: Certificate | None) -> dict[str, Any]:
    number = isinstance(check.value, float)
    before = earlier.figures.get(check.name) if earlier is not None else None
    return {
        "group": check.name.partition(":")[0],
        "name": check.name.partition(": ")[2],
        "full_name": check.name,
        "value": check.shown,
        "limit": f"{check.limit} {check.unit if number else ''}",
        "before": "" if before is None else f"{before:.4g}",
        "passed": check.passed,
        "advice": check.advice,
        "share": _share(check),
        "paper": PAPER.get(check.name, ""),
    }


def _share(check: Check) -> float | None:
    """How much of its limit a figure uses up, in per cent; None where there is no upper limit."""
    found = re.fullmatch(r"at most ([-\d.e+]+)", check.limit)
    if found is None or not isinstance(check.value, float) or float(found[1]) <= 0:
        return None
    return 100.0 * max(0.0, check.value) / float(found[1])
