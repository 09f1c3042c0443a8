"""What the status codes in footers and exception reports mean (g2core wiki, Status Codes)."""

CODES: dict[int, str] = {
    1: "error", 2: "would block", 3: "no operation", 4: "complete", 5: "system shutdown", 6: "system panic",
    10: "file too large", 11: "no such device", 12: "buffer empty", 13: "buffer full", 14: "buffer full, fatal",
    15: "initializing", 18: "system alarm", 20: "internal error", 21: "internal range error",
    22: "floating point error", 23: "divide by zero", 26: "initialization failure",
    28: "no room in the planner", 29: "generic exception", 34: "memory of the settings failed",
    35: "bad status report setting", 88: "buffer assertion", 89: "state assertion", 90: "settings assertion",
    91: "serial assertion", 92: "encoder assertion", 93: "stepper assertion", 94: "planner assertion",
    95: "machine assertion", 96: "controller assertion", 97: "stack overflow", 98: "memory fault",
    99: "assertion",
    100: "name not known", 101: "malformed command", 102: "number that cannot be read", 103: "type not supported",
    104: "read only", 105: "cannot be read", 106: "not accepted at this time", 107: "line too long",
    108: "below the smallest value", 109: "above the greatest value", 110: "value out of range",
    111: "JSON syntax error", 112: "too many JSON pairs", 113: "JSON answer too long", 115: "JSON nested too deep",
    116: "JSON value of a wrong type", 117: "input from a muted channel", 118: "checksum does not match",
    119: "line number out of sequence", 120: "checksum without a line number",
    130: "G-code error", 131: "G command not supported", 132: "M command not supported",
    133: "two commands of one modal group", 134: "axis missing", 135: "axis not allowed", 136: "axis not valid",
    137: "axis disabled", 138: "axis without a number", 139: "axis number not valid", 142: "no feed rate",
    145: "G53 needs G0 or G1", 146: "speed beyond limits", 148: "target is the present position",
    200: "error", 201: "move too short", 202: "move too brief", 203: "limit switch pressed",
    204: "rejected by an alarm", 205: "rejected by a shutdown", 206: "rejected by a panic", 207: "job killed",
    220: "target beyond the soft limits", 221: "target beyond the soft limits, X low",
    222: "target beyond the soft limits, X high", 223: "target beyond the soft limits, Y low",
    224: "target beyond the soft limits, Y high", 225: "target beyond the soft limits, Z low",
    226: "target beyond the soft limits, Z high", 227: "target beyond the soft limits, A low",
    228: "target beyond the soft limits, A high", 229: "target beyond the soft limits, B low",
    230: "target beyond the soft limits, B high", 231: "target beyond the soft limits, C low",
    232: "target beyond the soft limits, C high", 233: "arc beyond the soft limits",
    240: "homing failed", 241: "homing without a valid axis", 242: "homing search velocity is zero",
    243: "homing latch velocity is zero", 244: "homing travel is zero", 245: "homing latch backoff is negative",
    246: "homing input misconfigured", 247: "homing switches must be clear", 250: "probing failed",
}  # fmt: skip

JOB_KILLED = 207
_POSITION_KEPT = frozenset({JOB_KILLED, 201, 202, *range(220, 234)})
"""The board comes to rest along its path, and knows where. Everything else has lost the position, as far as mill knows:
a limit switch that was pressed says that the axes are not where they should be."""


def status_words(status: int) -> str:
    """A status code as a person reads it."""
    return f"status {status} ({CODES.get(status, 'no manual of ours names it')})"


def keeps_position(status: int) -> bool:
    """Whether the position can be trusted after the board stopped itself with this status."""
    return status in _POSITION_KEPT


def alarm_words(status: int) -> str:
    """Why the board stopped itself, as a person reads it."""
    kept = "kept" if keeps_position(status) else "lost"
    return f"ALARM {status} ({CODES.get(status, 'no manual of ours names it')}; position {kept})"
