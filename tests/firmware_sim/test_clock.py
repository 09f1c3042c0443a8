import pytest

from firmware_sim.clock import TICK_S, SimClock


def test_sleeping_advances_every_board_in_ticks_and_in_order():
    clock = SimClock(start_s=5.0)
    calls = []
    clock.attach(lambda time_s: calls.append(("a", time_s)))
    clock.attach(lambda time_s: calls.append(("b", time_s)))
    calls.clear()
    clock.sleep_s(0.005)
    assert [name for name, _ in calls] == ["a", "b"] * 3
    times = [time_s for name, time_s in calls if name == "a"]
    assert times == pytest.approx([5.002, 5.004, 5.005])
    assert all(b - a <= TICK_S + 1e-12 for a, b in zip([5.0, *times], times, strict=False))
    assert clock.now_s() == pytest.approx(5.005)


def test_time_never_goes_back():
    clock = SimClock(start_s=1.0)
    calls = []
    clock.attach(calls.append)
    clock.run_until(0.5)
    clock.sleep_s(0.0)
    clock.sleep_s(-1.0)
    assert clock.now_s() == 1.0
    assert calls == [1.0]
