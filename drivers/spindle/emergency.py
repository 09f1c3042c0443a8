"""The error codes of CiA 301 and CiA 402 in words; the same codes stand in EMCY frames, in 1003h and in 603Fh."""

HOST_SILENT = 0x8130
"""The drive missed the host's heartbeat."""

EXACT = {
    0x2110: "short circuit or earth leakage at the input",
    0x2220: "continuous over-current inside the drive",
    0x2230: "short circuit or earth leakage inside the drive",
    0x2310: "continuous over-current at the output",
    0x2320: "short circuit or earth leakage at the motor",
    0x2340: "short circuit at the motor",
    0x2350: "motor overload (I2t)",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase failure",
    0x3210: "over-voltage of the DC link",
    0x3220: "under-voltage of the DC link",
    0x4110: "ambient temperature too high",
    0x4210: "device temperature too high",
    0x4310: "drive temperature too high",
    0x5112: "supply of 24 V out of range",
    0x5113: "supply of 5 V out of range",
    0x5441: "safe torque off is active",
    0x5530: "parameter memory (EEPROM) failed",
    0x6010: "software reset by the drive's watchdog",
    0x6310: "parameters lost",
    0x6320: "parameter error",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or wrong commutation",
    0x7300: "sensor",
    0x7305: "incremental sensor 1",
    0x7306: "incremental sensor 2",
    0x7310: "speed sensor",
    0x7320: "position sensor",
    0x7500: "communication inside the drive",
    0x8110: "CAN overrun, frames were lost",
    0x8120: "CAN controller error passive",
    HOST_SILENT: "the host's heartbeat stayed away",
    0x8140: "recovered from bus-off",
    0x8150: "another node uses the same identifier",
    0x8210: "PDO too short, not processed",
    0x8220: "PDO too long",
    0x8250: "RPDO did not come in time",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8331: "torque fault",
    0x8400: "speed controller",
    0x8500: "position controller",
    0x8611: "following error",
    0x8612: "reference limit",
    0xF001: "deceleration",
}
BY_FAMILY = {
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "hardware of the drive",
    0x6: "software of the drive",
    0x7: "additional module",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "additional function or maker's own error",
}


def is_reset(code: int) -> bool:
    """Whether the code says that errors are gone."""
    return code & 0xFF00 == 0


def words(code: int) -> str:
    """The code and its meaning, the family's where the code itself is the maker's own."""
    return f"0x{code:04X} {EXACT.get(code) or BY_FAMILY.get(code >> 12, 'unknown error')}"
