"""An emulated DENSO RC8 with its arm, as a b-CAP server: services, handles, commands, slave mode, retries.

Written from the b-CAP communication specification and the RC8 provider user's guide. A reply is on its way a
millisecond after its request; switching the motor on takes longer, and the client is told meanwhile that it is still
being executed. A request that is sent again is answered from memory and not executed twice.

Left out: tasks, programs, moves that the controller plans itself, several clients at once, tools and work frames, and
the joints: the arm is a point with an orientation.
"""

import heapq
import itertools
from collections.abc import Callable
from typing import Any, Final

from firmware_sim.bcap_slave import Pose, SlaveMotion
from firmware_sim.bcap_wire import Request, read_request, write_reply
from firmware_sim.mechanics import Mechanics

POWER_UP_POSE: Final[Pose] = (350.0, -120.0, 240.0, 180.0, 0.0, 180.0, 5.0)
VERSION: Final = "2.12.0"
REPLY_S: Final = 0.001
MOTOR_ON_S: Final = 0.3
SIGN_OF_LIFE_S: Final = 0.08
REMEMBERED: Final = 64

S_OK: Final = 0
S_EXECUTING: Final = 0x00000900
E_NOT_IMPLEMENTED: Final = 0x80004001
E_ACCESS_DENIED: Final = 0x80070005
E_HANDLE: Final = 0x80070006
E_INVALID_ARGUMENT: Final = 0x80070057
E_MOTOR_OFF: Final = 0x81501003
E_EMERGENCY_STOP: Final = 0x83500178
AUTOMATIC: Final = 3

_CONTROLLER, _ROBOT, _FIRST_VARIABLE = 0x0101, 0x0201, 0x0301
_VARIABLES: Final = ("@ERROR_CODE", "@MODE", "@EMERGENCY_STOP", "@VERSION")

Outcome = tuple[int, Any]
"""Result and value."""


class RcController:
    """The controller from power-up at time zero; it stands with its motor off."""

    def __init__(self, mechanics: Mechanics, *, pose: Pose = POWER_UP_POSE) -> None:
        self._mechanics = mechanics
        self._start = pose
        self.motion = SlaveMotion(pose)
        self.mode = AUTOMATIC
        """1 manual, 2 teach check, 3 automatic."""
        self.version = VERSION
        self.motor_on = False
        self.error_code = 0
        self._has_service = self._has_controller = self._has_robot = self._arm_taken = False
        self._variables: dict[int, str] = {}
        self._emergency_stop = False
        self._now_s = 0.0
        self._shown: Pose = pose
        self._order = itertools.count()
        self._replies: list[tuple[float, int, bytes]] = []
        self._executing: dict[int, float] = {}
        self._remembered: dict[int, Outcome] = {}
        self._functions: dict[int, Callable[..., Outcome]] = {
            1: self._start_service, 2: self._stop_service, 3: self._connect, 4: self._disconnect, 7: self._get_robot,
            9: self._get_variable, 17: self._execute_controller, 64: self._execute_robot, 70: self._halt,
            84: self._release_robot, 101: self._get_value, 111: self._release_variable,
        }  # fmt: skip

    # What the bench calls.

    @property
    def state(self) -> str:
        """What its display would say."""
        if self.error_code:
            return "Alarm"
        return "Run" if self.motion.mode else "Idle"

    def commission(self, words: str) -> None:
        """A text that tells this controller from others of its make."""
        self.version = f"{VERSION} {words}"

    def raise_alarm(self, code: int) -> None:
        """An error of the controller's own: it stops, and leaves slave mode."""
        self.motion.stop()
        self.error_code = code

    def restart(self) -> None:
        """Somebody switches it off and on again; it knows nobody any more, and still where the arm is."""
        self.motion.stop()
        self.motor_on = False
        self.error_code = 0
        self._has_service = self._has_controller = self._has_robot = self._arm_taken = False
        self._variables.clear()
        self._replies.clear()
        self._executing.clear()
        self._remembered.clear()

    def receive(self, datagram: bytes) -> None:
        """One datagram of the host, now."""
        request = read_request(datagram)
        if request is None:
            return
        first = request.retries or request.serial
        if request.retries in self._executing:
            self._answer(request, (S_EXECUTING, None))
        elif request.retries in self._remembered:
            self._answer(request, self._remembered[request.retries])
        else:
            outcome = self._carry_out(request)
            self._remembered.pop(first, None)
            self._remembered[first] = outcome
            while len(self._remembered) > REMEMBERED:
                del self._remembered[next(iter(self._remembered))]
            self._answer(request, outcome, until_s=self._executing.get(first))

    def transmit(self) -> bytes:
        """The next datagram that has reached the host; b"" where there is none."""
        if self._replies and self._replies[0][0] <= self._now_s + 1e-9:
            return heapq.heappop(self._replies)[2]
        return b""

    def advance_to(self, time_s: float) -> None:
        """Let the controller's time go on to ``time_s``."""
        for first in [first for first, until_s in self._executing.items() if until_s <= time_s]:
            del self._executing[first]
        error = self.motion.advance_to(self._now_s, time_s)
        self._now_s = time_s
        if error:
            self.error_code = error
        if self.motion.pose != self._shown:
            self._shown = self.motion.pose
            x, y, z = (value - start for value, start in zip(self._shown[:3], self._start[:3], strict=True))
            self._mechanics.move_to(time_s, (x, y, z))
        self._look_at_switches()

    def _look_at_switches(self) -> None:
        """Its end switches are in the circuit of the emergency stop."""
        self._emergency_stop = any(self._mechanics.limit_switches())
        if self._emergency_stop and self.motor_on:
            self.motor_on = False
            self.raise_alarm(E_EMERGENCY_STOP)

    # The conversation.

    def _answer(self, request: Request, outcome: Outcome, *, until_s: float | None = None) -> None:
        if until_s is not None:
            at_s = self._now_s + SIGN_OF_LIFE_S
            while at_s < until_s:
                self._post(at_s, request, (S_EXECUTING, None))
                at_s += SIGN_OF_LIFE_S
        self._post((self._now_s if until_s is None else until_s) + REPLY_S, request, outcome)

    def _post(self, at_s: float, request: Request, outcome: Outcome) -> None:
        reply = write_reply(request.serial, request.retries, *outcome)
        heapq.heappush(self._replies, (at_s, next(self._order), reply))

    def _carry_out(self, request: Request) -> Outcome:
        function = self._functions.get(request.function)
        if function is None:
            return E_NOT_IMPLEMENTED, None
        if request.function > 1 and not self._has_service:
            return E_HANDLE, None
        self._serial = request.retries or request.serial
        try:
            return function(*request.arguments)
        except (TypeError, ValueError):
            return E_INVALID_ARGUMENT, None

    def _start_service(self, options: str = "") -> Outcome:
        self._has_service = True
        return S_OK, None

    def _stop_service(self) -> Outcome:
        self._has_service = self._has_controller = self._has_robot = self._arm_taken = False
        self.motion.stop()
        return S_OK, None

    def _connect(self, name: str, provider: str, machine: str, options: str) -> Outcome:
        if provider.lower() != "caoprov.denso.vrc":
            return E_INVALID_ARGUMENT, None
        self._has_controller = True
        return S_OK, _CONTROLLER

    def _disconnect(self, handle: int) -> Outcome:
        if handle != _CONTROLLER or not self._has_controller:
            return E_HANDLE, None
        self._has_controller = False
        return S_OK, None

    def _get_robot(self, handle: int, name: str, options: str = "") -> Outcome:
        if handle != _CONTROLLER or not self._has_controller:
            return E_HANDLE, None
        self._has_robot = True
        return S_OK, _ROBOT

    def _release_robot(self, handle: int) -> Outcome:
        if handle != _ROBOT or not self._has_robot:
            return E_HANDLE, None
        self._has_robot = False
        return S_OK, None

    def _get_variable(self, handle: int, name: str, options: str = "") -> Outcome:
        if handle != _CONTROLLER or not self._has_controller:
            return E_HANDLE, None
        if name not in _VARIABLES:
            return E_INVALID_ARGUMENT, None
        handle = _FIRST_VARIABLE + _VARIABLES.index(name)
        self._variables[handle] = name
        return S_OK, handle

    def _release_variable(self, handle: int) -> Outcome:
        return (E_HANDLE if self._variables.pop(handle, None) is None else S_OK), None

    def _get_value(self, handle: int) -> Outcome:
        match self._variables.get(handle):
            case "@ERROR_CODE":
                return S_OK, self.error_code - (self.error_code >> 31 << 32)
            case "@MODE":
                return S_OK, self.mode
            case "@EMERGENCY_STOP":
                return S_OK, self._emergency_stop
            case "@VERSION":
                return S_OK, self.version
            case _:
                return E_HANDLE, None

    def _execute_controller(self, handle: int, command: str, argument: Any = None) -> Outcome:
        if handle != _CONTROLLER or not self._has_controller:
            return E_HANDLE, None
        if command.lower() != "clearerror":
            return E_NOT_IMPLEMENTED, None
        if self.motion.mode:
            return E_ACCESS_DENIED, None
        self.error_code = 0
        return S_OK, None

    # The arm.

    def _halt(self, handle: int, options: str = "") -> Outcome:
        if handle != _ROBOT or not self._has_robot:
            return E_HANDLE, None
        self.motion.stop()
        return S_OK, None

    def _execute_robot(self, handle: int, command: str, argument: Any = None) -> Outcome:
        if handle != _ROBOT or not self._has_robot:
            return E_HANDLE, None
        match command.lower():
            case "takearm":
                self._arm_taken = self._arm_taken or not self.motion.mode
                return S_OK if not self.motion.mode else E_ACCESS_DENIED, None
            case "givearm":
                self._arm_taken = False
                return S_OK, None
            case "motor":
                return self._switch_motor(argument)
            case "extspeed":
                return (S_OK if self._arm_taken else E_ACCESS_DENIED), None
            case "curpos":
                return S_OK, self.motion.pose
            case "slvgetmode":
                return S_OK, self.motion.mode
            case "slvchangemode":
                return self._change_mode(int(argument))
            case "slvmove":
                return self._slave_move(argument)
            case _:
                return E_NOT_IMPLEMENTED, None

    def _switch_motor(self, argument: Any) -> Outcome:
        on = bool(argument[0] if isinstance(argument, list) else argument)
        if not self._arm_taken or self.motion.mode:
            return E_ACCESS_DENIED, None
        if on and self._emergency_stop:
            return E_EMERGENCY_STOP, None
        if on and self.error_code:
            return self.error_code, None
        if on and not self.motor_on:
            self._executing[self._serial] = self._now_s + MOTOR_ON_S
        self.motor_on = on
        return S_OK, None

    def _change_mode(self, mode: int) -> Outcome:
        if mode == 0:
            self.motion.stop()
            return S_OK, None
        if mode != 1:
            return E_INVALID_ARGUMENT, None
        if not self._arm_taken or self.motion.mode:
            return E_ACCESS_DENIED, None
        if self.error_code:
            return self.error_code, None
        if not self.motor_on:
            return E_MOTOR_OFF, None
        self.motion.enter(mode)
        return S_OK, None

    def _slave_move(self, argument: Any) -> Outcome:
        if len(argument) != 8 or not all(isinstance(each, float) for each in argument):
            return E_INVALID_ARGUMENT, None
        return self.motion.put(tuple(argument[:7])), self.motion.pose
