"""The registers of Delta's VFD drives as far as a drill needs them (MS300 user manual, groups 00 to 09, appendix A).

A parameter "09-03" is the register 0903h. VFD-E, VFD-EL and C2000 have the same ones, unless a line says otherwise.
"""

IDENTITY_CODE, FIRMWARE = 0x0000, 0x0006
STOP_METHOD = 0x0016
RAMP_TO_STOP = 0
GREATEST_FREQUENCY = 0x0100
PAST_FAULTS = (0x0611, 0x0612, 0x0613, 0x0614, 0x0615, 0x0616)
"""Newest first; not in VFD-E and VFD-EL."""
SILENCE_TREATMENT, SILENCE_TIME = 0x0902, 0x0903
FAULT_AND_RAMP_TO_STOP = 1
SILENCE_UNIT_S = 0.1

COMMAND, FREQUENCY_COMMAND, CONTROL = 0x2000, 0x2001, 0x2002
STOP = 0b01
RUN_FORWARD = 0b01_00_10
RESET_FAULT = 0b10

REPORT, REPORT_LENGTH = 0x2100, 5
"""Fault and warning, status, frequency command, output frequency, output current."""
CURRENT_DIGITS = 0x211F
"""Decimals of the current in its high byte; VFD-E and VFD-EL have it not, and give one decimal."""

RUN_BITS = 0b11
STANDING, RUNNING = 0b00, 0b11
BACKWARD = 0b11_000
FREQUENCY_BY_WIRE, COMMAND_BY_WIRE = 1 << 8, 1 << 10

EXCEPTIONS = {
    1: "function not supported",
    2: "no such register",
    3: "value not allowed",
    4: "cannot be done now",
}
NO_SUCH_REGISTER = 2

HOST_SILENT = 58
FAULTS = {
    1: "over-current while speeding up, ocA",
    2: "over-current while slowing down, ocd",
    3: "over-current at speed, ocn",
    4: "ground fault, GFF",
    6: "over-current at standstill, ocS",
    7: "over-voltage while speeding up, ovA",
    8: "over-voltage while slowing down, ovd; a longer deceleration time, parameter 01-13, helps",
    9: "over-voltage at speed, ovn",
    10: "over-voltage at standstill, ovS",
    11: "low voltage while speeding up, LvA",
    12: "low voltage while slowing down, Lvd",
    13: "low voltage at speed, Lvn",
    14: "low voltage at standstill, LvS",
    15: "input phase missing, orP",
    16: "power stage too hot, oH1",
    21: "drive overloaded, oL",
    22: "motor overloaded, EoL1",
    23: "motor 2 overloaded, EoL2",
    26: "over-torque, ot1",
    27: "over-torque, ot2",
    49: "external fault, EF",
    50: "emergency stop input, EF1",
    54: "communication error CE1",
    55: "communication error CE2",
    56: "communication error CE3",
    57: "communication error CE4",
    HOST_SILENT: "the host's heartbeat stayed away, CE10",
}
"""What the low byte of 2100h tells."""


def fault_words(code: int) -> str:
    """A fault code as a person reads it."""
    return f"{code} ({FAULTS.get(code, 'see the list of fault codes in the manual of the drive')})"
