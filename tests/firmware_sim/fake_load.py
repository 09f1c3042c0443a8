"""A shaft without a world: what the drive's tests turn."""


class FakeLoad:
    def __init__(self, torque: float = 0.05) -> None:
        self.torque = torque
        self.speeds: list[tuple[float, float]] = []

    def turn(self, time_s: float, speed_rpm: float) -> None:
        self.speeds.append((time_s, speed_rpm))

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return self.torque
