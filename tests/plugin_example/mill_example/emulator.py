"""The other end of both wires, written from the wire's description and not from the drivers.

``python -m mill_example.emulator`` serves them on two ports, prints their names as JSON, then one line for each host
that introduces itself, and ends with its standard input.
"""

import json
import math
import os
import select
import sys
import time
from collections import deque

from firmware_sim.ptys import SerialPty

LOW_MM, HIGH_MM = (-5.0, -25.0, -15.0), (30.0, 15.0, 15.0)
HOME_MM = (29.0, 14.0, 14.0)
HOMING_S = 0.2
RAMP_RPM_PER_S = 100_000.0
HOST_SILENT_S = 0.25


class Lines:
    """Bytes in, urgent ones apart; answers out."""

    def __init__(self) -> None:
        self._line = b""
        self._out = b""
        self.time_s = 0.0
        self.introduced = 0

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        for byte in data:
            if byte < 4:
                self.urgent(byte)
            elif byte == 10:
                words, self._line = self._line.decode("ascii", "replace").split(" "), b""
                self.introduced += words == ["who"]
                self._out += self.answer(words).encode() + b"\n"
            else:
                self._line += bytes([byte])

    def transmit(self) -> bytes:
        """Bytes for the host."""
        data, self._out = self._out, b""
        return data

    def advance_to(self, time_s: float) -> None:
        """Let time pass."""
        raise NotImplementedError

    def urgent(self, byte: int) -> None:
        """Act at once."""
        raise NotImplementedError

    def answer(self, words: list[str]) -> str:
        """What one line gets back."""
        raise NotImplementedError


class Stage(Lines):
    """Three axes that go at the speed they are told, from one moment to the next."""

    def __init__(self) -> None:
        super().__init__()
        self._at = (0.0, 0.0, 0.0)
        self._queue: deque[tuple[tuple[float, float, float], float]] = deque()
        self._homing_until_s = math.nan
        self._alarm = "not homed"
        self._held = False
        self._floor = LOW_MM[2]

    def advance_to(self, time_s: float) -> None:
        """Let the axes move on."""
        left_s, self.time_s = time_s - self.time_s, time_s
        if time_s >= self._homing_until_s:
            self._homing_until_s, self._at = math.nan, HOME_MM
        while left_s > 0 and self._queue and not self._held:
            target, feed = self._queue[0]
            way = math.dist(self._at, target)
            if way <= feed * left_s:
                left_s -= way / feed
                self._at = target
                self._queue.popleft()
            else:
                share = feed * left_s / way
                x, y, z = (a + share * (b - a) for a, b in zip(self._at, target, strict=True))
                self._at, left_s = (x, y, z), 0.0

    def urgent(self, byte: int) -> None:
        if byte == 3:
            self._alarm = "halted while moving" if self._moving else self._alarm or "halted"
            self._queue.clear()
            self._homing_until_s, self._held = math.nan, False
        elif byte in {1, 2}:
            self._held = byte == 1 and self._moving

    @property
    def _moving(self) -> bool:
        return bool(self._queue) or not math.isnan(self._homing_until_s)

    def answer(self, words: list[str]) -> str:
        match words:
            case ["who"]:
                return "Example stage 1.0 S7"
            case ["travel"]:
                return " ".join(f"{value:.4f}" for value in (*LOW_MM[:2], self._floor, *HIGH_MM))
            case ["home"]:
                self._alarm, self._homing_until_s = "", self.time_s + HOMING_S
                return "ok"
            case ["where"]:
                return self._where()
            case ["drop"]:
                self._queue.clear()
                self._held = False
                return "ok"
            case ["floor", height] if not self._moving:
                self._floor = float(height)
                return "ok"
            case ["go", *numbers] if len(numbers) == 4:
                x, y, z, feed = map(float, numbers)
                if self._alarm:
                    return f"no {self._alarm}"
                if not all(a <= b <= c for a, b, c in zip((*LOW_MM[:2], self._floor), (x, y, z), HIGH_MM, strict=True)):
                    return "no that is outside the travel"
                self._queue.append(((x, y, z), feed))
                return "ok"
        return "no such command now"

    def _where(self) -> str:
        if self._alarm:
            state = "alarm"
        elif not math.isnan(self._homing_until_s):
            state = "homing"
        else:
            state = "held" if self._held else "moving" if self._queue else "idle"
        queued_s, at = 0.0, self._at
        for target, feed in self._queue:
            queued_s += math.dist(at, target) / feed
            at = target
        numbers = " ".join(f"{value:.4f}" for value in (*self._at, queued_s))
        return f"{state} {numbers} {self._alarm}".rstrip()


class Drill(Lines):
    """A motor that ramps, and stops when the host falls silent."""

    def __init__(self) -> None:
        super().__init__()
        self._speed = self._target = 0.0
        self._heard_s = 0.0
        self._fault = ""

    def receive(self, data: bytes) -> None:
        self._heard_s = self.time_s
        super().receive(data)

    def advance_to(self, time_s: float) -> None:
        """Let the motor ramp."""
        step, self.time_s = RAMP_RPM_PER_S * (time_s - self.time_s), time_s
        if self._target and time_s - self._heard_s > HOST_SILENT_S:
            self._target, self._fault = 0.0, "the host was silent"
        self._speed += max(-step, min(step, self._target - self._speed))

    def urgent(self, byte: int) -> None:
        if byte == 3:
            self._target = 0.0

    def answer(self, words: list[str]) -> str:
        match words:
            case ["who"]:
                return "Example drill 1.0 D9"
            case ["spin", speed] if not self._fault:
                self._target = float(speed)
                return "ok"
            case ["say"]:
                torque = 0.05 if self._speed else 0.0
                return f"{self._speed:.1f} {self._target:.1f} {torque:.3f} {self._fault}".rstrip()
        return f"no {self._fault or 'such command'}"


def main() -> None:
    """Serve both until standard input closes."""
    devices = {"motion": Stage(), "spindle": Drill()}
    ports = {name: SerialPty() for name in devices}
    print(json.dumps({name: port.path for name, port in ports.items()}), flush=True)
    began_s, told = time.monotonic(), dict.fromkeys(devices, 0)
    while True:
        readable, _, _ = select.select([sys.stdin, *ports.values()], [], [], 0.001)
        if sys.stdin in readable and not os.read(sys.stdin.fileno(), 1):
            return
        for name, device in devices.items():
            device.advance_to(time.monotonic() - began_s)
            if data := ports[name].read():
                device.receive(data)
            ports[name].write(device.transmit())
            if device.introduced > told[name]:
                told[name] = device.introduced
                print(name, flush=True)


if __name__ == "__main__":
    main()
