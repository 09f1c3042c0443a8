"""What the result of a b-CAP reply (HRESULT) means: RC8 error code list and b-CAP communication specification."""

S_OK = 0x00000000
S_EXECUTING = 0x00000900
S_BUF_FULL = 0x0F200501
E_BUF_FULL = 0x83201483
E_BUF_EMPTY = 0x84201482
E_NO_SLAVE_MODE = 0x83500121
E_HANDLE = 0x80070006
_FAILURE = 0x80000000

WORDS = {
    S_OK: "done",
    0x00000001: "done, and the answer is no",
    S_EXECUTING: "still executing",
    S_BUF_FULL: "set-point taken, buffer full",
    0x80004001: "not implemented",
    0x80004005: "failed",
    0x8000FFFF: "unexpected failure",
    0x80000900: "timed out in the controller",
    0x80070005: "access denied: another client or task has the arm, or the executable token is not with Ethernet",
    E_HANDLE: "handle not known: the controller was restarted, or the session was ended",
    0x8007000E: "controller out of memory",
    0x80070057: "argument not valid",
    0x81501003: "motor off",
    E_BUF_FULL: "set-point buffer full",
    E_BUF_EMPTY: "set-point late or step too fast: the buffer ran empty, and slave mode was left",
    0x84201486: "generation of positions stopped",
    E_NO_SLAVE_MODE: "not in slave mode",
    0x8350106E: "motor on refused while it switches off",
    0x83500178: "emergency stop pressed",
}
_RANGES = {
    0x84204040: "acceleration of a set-point too high, axis",
    0x84204050: "speed of a set-point too high, axis",
}


def failed(result: int) -> bool:
    """Whether a reply refuses."""
    return bool(result & _FAILURE)


def result_words(result: int) -> str:
    """An HRESULT as a person reads it."""
    words = WORDS.get(result)
    axis = result & 0xF
    if words is None and 1 <= axis <= 8 and (of := _RANGES.get(result & ~0xF)) is not None:
        words = f"{of} {axis}"
    return f"error {result:#010x} ({words or 'see the error code list of the controller'})"
