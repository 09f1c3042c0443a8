"""The controller and its arm behind a b-CAP session: start-up and shut-down order, variables, commands.

RC8 provider user's guide: CaoController, CaoRobot, CaoVariable; b-CAP communication specification: slave mode.
"""

import contextlib
import math

from drivers.errors import DeviceError, DeviceFaultError, ProtocolError
from drivers.motion.bcap import session as bcap
from drivers.motion.bcap.packet import Value
from drivers.motion.bcap.results import result_words
from drivers.motion.bcap.session import BcapSession, Call

PROVIDER = "caoProv.DENSO.VRC"
ERROR_CODE, MODE, EMERGENCY_STOP, VERSION = "@ERROR_CODE", "@MODE", "@EMERGENCY_STOP", "@VERSION"
MOTOR_S = 15.0
POSE_BUFFERED = 0x001
"""Slave mode for poses, each of which waits in the buffer for its turn."""
_MANUAL_MODES = {1: "manual", 2: "teach check"}

Pose = tuple[float, ...]
"""X, Y, Z in mm, RX, RY, RZ in degrees, figure."""


class Robot:
    """Connected after ``connect()``."""

    def __init__(self, session: BcapSession) -> None:
        self._session = session
        self._controller = 0
        self._variables: dict[str, int] = {}
        self.handle: int | None = None
        """Of the arm; None before it is connected."""
        self._has_arm = False

    def connect(self) -> None:
        """Start the service, take handles. What is there from before is forgotten."""
        session = self._session
        self.handle, self._has_arm = None, False
        self._variables.clear()
        session.request(bcap.SERVICE_START, "")
        self._controller = _whole(
            session, session.request(bcap.CONTROLLER_CONNECT, "", PROVIDER, "localhost", ""), "handle of the controller"
        )
        for name in (ERROR_CODE, MODE, EMERGENCY_STOP, VERSION):
            reply = session.request(bcap.CONTROLLER_GETVARIABLE, self._controller, name, "")
            self._variables[name] = _whole(session, reply, f"handle of {name}")
        reply = session.request(bcap.CONTROLLER_GETROBOT, self._controller, "Arm", "")
        self.handle = _whole(session, reply, "handle of the arm")
        session.handles_lost = False

    def disconnect(self) -> None:
        """Motor off, arm given, handles released, service stopped; what fails on the way keeps nothing else back."""
        session = self._session
        if self._has_arm:
            for command, value in (("Motor", (0, 1)), ("GiveArm", None)):
                with contextlib.suppress(DeviceError):
                    self.execute(command, value, limit_s=MOTOR_S)
        if self.handle is not None:
            with contextlib.suppress(DeviceError):
                session.request(bcap.ROBOT_RELEASE, self.handle)
        for handle in self._variables.values():
            with contextlib.suppress(DeviceError):
                session.request(bcap.VARIABLE_RELEASE, handle)
        for function, arguments in ((bcap.CONTROLLER_DISCONNECT, (self._controller,)), (bcap.SERVICE_STOP, ())):
            with contextlib.suppress(DeviceError):
                session.request(function, *arguments)
        self.handle = None

    def take(self) -> None:
        """Clear errors, take the arm, switch its motor on. Not in slave mode.

        Raises:
            DeviceFaultError: an emergency stop is pressed, the mode switch is not at automatic, or it is refused.
        """
        name = self._session.name
        if self.read(EMERGENCY_STOP):
            raise DeviceFaultError(f"{name}: the emergency stop is pressed; release it, then home()")
        if (mode := _MANUAL_MODES.get(_whole(self._session, self.read(MODE), MODE))) is not None:
            raise DeviceFaultError(f"{name}: the mode switch is at {mode}; turn it to automatic, then home()")
        self._session.request(bcap.CONTROLLER_EXECUTE, self._controller, "ClearError", None)
        # Its second number keeps the tool that was chosen at the controller: positions are those of that tool's tip.
        self.execute("TakeArm", (0, 1))
        self._has_arm = True
        self.execute("Motor", (1, 0), limit_s=MOTOR_S)
        self.execute("ExtSpeed", (100.0,))

    def read(self, variable: str) -> Value:
        """The value of one of the controller's own variables."""
        return self._session.request(bcap.VARIABLE_GETVALUE, self._variables[variable])

    def error(self) -> str | None:
        """The controller's error in words; None where there is none."""
        code = _whole(self._session, self.read(ERROR_CODE), ERROR_CODE) & 0xFFFFFFFF
        return result_words(code) if code else None

    def pose(self, *, retry_s: float | None = None) -> Pose:
        """Where the tool's tip is now, in the robot's frame."""
        reply = self.execute("CurPos", None, retry_s=retry_s)
        numbers = tuple(each for each in reply if isinstance(each, float)) if isinstance(reply, tuple) else ()
        if len(numbers) < 7 or not all(map(math.isfinite, numbers)):
            raise ProtocolError(f"{self._session.name}: CurPos answered {reply!r}, due are 7 numbers; is this an RC8?")
        return numbers[:7]

    def execute(self, command: str, value: Value, *, retry_s: float | None = None, limit_s: float = 1.0) -> Value:
        """One command of the arm, to its reply."""
        return self._session.request(bcap.ROBOT_EXECUTE, self.handle, command, value, retry_s=retry_s, limit_s=limit_s)

    def begin(self, command: str, value: Value, *, retry_s: float) -> Call:
        """One command of the arm, whose reply is looked for later."""
        return self._session.begin(bcap.ROBOT_EXECUTE, self.handle, command, value, retry_s=retry_s)


def _whole(session: BcapSession, value: Value, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ProtocolError(f"{session.name}: {what} is {value!r}, due is a whole number; is this an RC8?")
    return value
