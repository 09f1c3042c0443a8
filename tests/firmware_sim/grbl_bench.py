"""A GRBL board on a desk: three motors with switches at fixed distances from power-up, a probe at a fixed height."""

from collections.abc import Mapping

from firmware_sim.grbl_board import GrblBoard

STEP_S = 0.0005


class Desk:
    """Mechanics that only remember where they were."""

    def __init__(self, switches_mm=(12.0, 10.0, 10.0), probe_mm: float = -20.0) -> None:
        self.switches_mm = switches_mm
        self.probe_mm = probe_mm
        self.axes_mm = (0.0, 0.0, 0.0)
        self.track: list[tuple[float, tuple[float, float, float]]] = [(0.0, self.axes_mm)]

    def move_to(self, time_s: float, axes_mm: tuple[float, float, float]) -> None:
        self.axes_mm = axes_mm
        self.track.append((time_s, axes_mm))

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = (at >= switch - 1e-9 for at, switch in zip(self.axes_mm, self.switches_mm, strict=True))
        return x, y, z

    def probe_closed(self) -> bool:
        return self.axes_mm[2] <= self.probe_mm + 1e-9


class Host:
    """Writes bytes, lets time pass, and notes each line with the time of its last byte."""

    def __init__(self, dialect: str, settings: Mapping[str, float] = {}, desk: Desk | None = None) -> None:
        self.desk = desk or Desk()
        self.board = GrblBoard(self.desk, dialect=dialect, settings=settings)
        self.time_s = 0.0
        self.lines: list[tuple[float, str]] = []
        self._rest = b""

    def run_until(self, time_s: float, step_s: float = STEP_S) -> None:
        while self.time_s < time_s - 1e-9:
            self.time_s = min(time_s, self.time_s + step_s)
            self.board.advance_to(self.time_s)
            *lines, self._rest = (self._rest + self.board.transmit()).split(b"\r\n")
            self.lines += [(self.time_s, line.decode("latin-1")) for line in lines]

    def run(self, duration_s: float) -> None:
        self.run_until(self.time_s + duration_s)

    def ask(self, data: bytes, wait_s: float = 0.05) -> list[str]:
        """What comes back within ``wait_s`` of writing ``data``; blank lines left out."""
        first = len(self.lines)
        self.board.receive(data)
        self.run(wait_s)
        return [line for _, line in self.lines[first:] if line]

    def report(self) -> dict[str, str]:
        """One status report, field by field; the state under ``state``."""
        first = len(self.lines)
        self.board.receive(b"?")
        end_s = self.time_s + 0.3
        while not (found := [line for _, line in self.lines[first:] if line.startswith("<")]):
            assert self.time_s < end_s, f"no report within 0.3 s: {self.lines[-3:]}"
            self.run(0.001)
        state, *fields = found[0][1:-1].split("|")
        return {"state": state, **dict(field.split(":", 1) for field in fields)}

    def state(self) -> str:
        return self.report()["state"]

    def position_mm(self) -> tuple[float, ...]:
        return tuple(float(number) for number in self.report()["MPos"].split(","))

    def wait_for_state(self, state: str, timeout_s: float = 30.0) -> None:
        end_s = self.time_s + timeout_s
        while self.state() != state:
            assert self.time_s < end_s, f"no {state} within {timeout_s} s: {self.lines[-3:]}"


FAST = {
    **{f"${100 + axis}": 1000.0 for axis in range(3)},
    **{f"${110 + axis}": 1200.0 for axis in range(3)},
    **{f"${120 + axis}": 500.0 for axis in range(3)},
    "$130": 35.0, "$131": 40.0, "$132": 28.0, "$22": 1.0, "$24": 60.0, "$25": 1200.0,
}  # fmt: skip
"""The default rig's settings."""


def unlocked(dialect: str, settings: Mapping[str, float] = FAST) -> Host:
    """A board that has booted and been unlocked, reports everything, and stands at machine zero of power-up."""
    host = Host(dialect, settings if dialect == "grblhal" else {"$10": 3.0, **settings})
    host.run(0.1)
    host.ask(b"$X\n")
    return host


def homed(dialect: str, settings: Mapping[str, float] = FAST) -> Host:
    host = unlocked(dialect, settings)
    assert host.ask(b"$H\n", 10.0)[-1] == "ok"
    return host
