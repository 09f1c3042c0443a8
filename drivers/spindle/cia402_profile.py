"""The object dictionary and the state machine of CiA 402, as far as a drill in profile velocity mode needs them."""

from enum import Enum

from drivers.spindle.canopen_node import Entry

DEVICE_TYPE = Entry(0x1000, 0, "I", "device type")
CONSUMER_HEARTBEAT = Entry(0x1016, 1, "I", "consumer heartbeat time")
PRODUCER_HEARTBEAT = Entry(0x1017, 0, "H", "producer heartbeat time")
VENDOR = Entry(0x1018, 1, "I", "vendor id")
PRODUCT = Entry(0x1018, 2, "I", "product code")
REVISION = Entry(0x1018, 3, "I", "revision number")
SERIAL = Entry(0x1018, 4, "I", "serial number")
ERROR_BEHAVIOUR = Entry(0x1029, 1, "B", "communication error behaviour")
ABORT_OPTION = Entry(0x6007, 0, "h", "abort connection option code")
ERROR_COUNT = Entry(0x1003, 0, "B", "number of past errors")
ERROR_CODE = Entry(0x603F, 0, "H", "error code")
CONTROLWORD = Entry(0x6040, 0, "H", "controlword")
QUICK_STOP_OPTION = Entry(0x605A, 0, "h", "quick stop option code")
MODE = Entry(0x6060, 0, "b", "mode of operation")
MODE_DISPLAY = Entry(0x6061, 0, "b", "mode of operation display")
MAX_PROFILE_VELOCITY = Entry(0x607F, 0, "I", "max profile velocity")
MAX_MOTOR_SPEED = Entry(0x6080, 0, "I", "max motor speed")
ACCELERATION = Entry(0x6083, 0, "I", "profile acceleration")
DECELERATION = Entry(0x6084, 0, "I", "profile deceleration")
QUICK_STOP_DECELERATION = Entry(0x6085, 0, "I", "quick stop deceleration")
VELOCITY_UNIT = Entry(0x60A9, 0, "I", "SI unit of velocity")
SUPPORTED_MODES = Entry(0x6502, 0, "I", "supported drive modes")

DRIVE_PROFILE = 402
PROFILE_VELOCITY = 3
PROFILE_VELOCITY_SUPPORTED = 1 << 2
RPM = 0x00B44700
ABORT_BY_QUICK_STOP = 3
QUICK_STOP_THEN_DISABLED = 2
STAY_OPERATIONAL = 1
"""The drive stops by 6007h; staying operational, it goes on answering SYNC and obeying stop()."""

SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE = 0x000F
QUICK_STOP = 0x0002
DISABLE_VOLTAGE = 0x0000
FAULT_RESET = 0x0080
TARGET_REACHED = 1 << 10


class DriveState(Enum):
    """The states of CiA 402: mask and value of the statusword."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @classmethod
    def of(cls, statusword: int) -> "DriveState | None":
        """The state that a statusword tells; None for one that the standard does not know."""
        return next((state for state in cls if statusword & state.value[0] == state.value[1]), None)

    def __str__(self) -> str:
        return self.name.replace("_", " ").lower()


TOWARDS_ENABLED = {
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
    DriveState.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}
FAULTY = (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)
