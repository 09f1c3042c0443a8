"""What the numbers after ``error:`` and ``ALARM:`` mean (GRBL 1.1 manual, grblHAL where it goes on)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AlarmMeaning:
    """An alarm in words, and whether the position can still be trusted after it."""

    words: str
    position_lost: bool


ERRORS: dict[int, str] = {
    1: "a word without its letter",
    2: "a number that cannot be read",
    3: "'$' command not known",
    4: "negative value where a positive one is due",
    5: "homing is switched off ($22)",
    6: "step pulse too short",
    7: "settings could not be read from memory, defaults are in use",
    8: "'$' command needs standstill",
    9: "G-code is locked out by an alarm or a jog",
    10: "soft limits need homing ($22)",
    11: "line too long",
    12: "setting exceeds the highest step rate",
    13: "safety door open",
    14: "build info or startup line too long",
    15: "jog target outside the travel",
    16: "jog command not allowed",
    17: "laser mode needs PWM",
    18: "reset asserted",
    19: "value must be above zero",
    20: "G-code command not supported",
    21: "two commands of one modal group",
    22: "no feed rate",
    23: "whole number needed",
    24: "two commands that both want axis words",
    25: "repeated word",
    26: "no axis words",
    27: "line number not valid",
    28: "value word missing",
    29: "work coordinate system not supported",
    30: "G53 needs G0 or G1",
    31: "axis words without a command for them",
    32: "arc without an axis in its plane",
    33: "motion target not valid",
    34: "arc radius not valid",
    35: "arc without an offset in its plane",
    36: "unused words",
    37: "tool length offset on the wrong axis",
    38: "tool number too high",
    39: "value out of range",
    40: "tool change pending",
    41: "spindle not running",
    42: "plane not allowed",
    43: "feed rate too high",
    44: "spindle speed out of range",
    45: "only homing is allowed while a limit switch is pressed",
    46: "homing is required",
    47: "no current tool",
    48: "conflicting value words",
    49: "power-on self test failed",
    50: "emergency stop active",
    51: "motor fault",
    52: "setting out of range",
    53: "setting not available",
    54: "retract position below drill depth",
    55: "two auto-squared axes cannot home together",
    56: "coordinate system locked",
    57: "unexpected end of file marker",
    58: "port not available",
    60: "file system not mounted",
    61: "file could not be read",
    62: "directory could not be listed",
    63: "directory not found",
    64: "file is empty",
    70: "Bluetooth could not start",
    77: "log-in required",
    78: "access denied",
    79: "not allowed during a critical event",
}

HOMING_REQUIRED = 11

ALARMS: dict[int, AlarmMeaning] = {
    1: AlarmMeaning("hard limit switch pressed", position_lost=True),
    2: AlarmMeaning("target beyond the soft limits", position_lost=False),
    3: AlarmMeaning("reset while in motion", position_lost=True),
    4: AlarmMeaning("probe in the wrong state before probing", position_lost=False),
    5: AlarmMeaning("probe made no contact", position_lost=False),
    6: AlarmMeaning("reset while homing", position_lost=True),
    7: AlarmMeaning("safety door opened while homing", position_lost=True),
    8: AlarmMeaning("switch still pressed after the homing pull-off", position_lost=True),
    9: AlarmMeaning("homing found no switch within the search distance", position_lost=True),
    10: AlarmMeaning("emergency stop", position_lost=True),
    HOMING_REQUIRED: AlarmMeaning("homing is required", position_lost=True),
    12: AlarmMeaning("limit switch pressed at start", position_lost=True),
    13: AlarmMeaning("probe protection", position_lost=True),
    14: AlarmMeaning("spindle not at speed", position_lost=False),
    15: AlarmMeaning("homing found no second switch", position_lost=True),
    16: AlarmMeaning("power-on self test failed", position_lost=True),
    17: AlarmMeaning("motor fault", position_lost=True),
    18: AlarmMeaning("homing is wrongly configured", position_lost=True),
}


def error_words(code: int) -> str:
    """``error:N`` as a person reads it."""
    return f"error:{code} ({ERRORS.get(code, 'no manual of ours names it')})"


def alarm_meaning(code: int) -> AlarmMeaning:
    """An alarm of the table; one that no manual names has lost the position."""
    return ALARMS.get(code, AlarmMeaning("no manual of ours names it", position_lost=True))


def alarm_words(code: int) -> str:
    """``ALARM:N`` as a person reads it."""
    meaning = alarm_meaning(code)
    return f"ALARM:{code} ({meaning.words}; position {'lost' if meaning.position_lost else 'kept'})"
