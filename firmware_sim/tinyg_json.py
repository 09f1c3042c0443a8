"""The JSON that a g2core board reads: strict, or relaxed, without quotes and with n, t, f for null, true, false."""

import json
import re
from typing import Any

_KEYS = re.compile(r"([{,])\s*([A-Za-z0-9_.]+)\s*:")
_VALUES = re.compile(r":\s*([ntf])\s*(?=[,}])")
_LITERALS = {"n": "null", "t": "true", "f": "false"}


def read_json(text: str) -> dict[str, Any]:
    """One object.

    Raises:
        ValueError: it is none.
    """
    strict = _VALUES.sub(lambda found: f":{_LITERALS[found[1]]}", _KEYS.sub(r'\1"\2":', text))
    try:
        found = json.loads(strict, parse_constant=_no_number)
    except RecursionError as error:
        raise ValueError(text) from error
    if not isinstance(found, dict):
        raise ValueError(text)
    return found


def _no_number(text: str) -> float:
    raise ValueError(text)
