"""What the GRBL driver reads out of a controller's settings, refuses, and writes; the board is the emulated one."""

import pytest
from grbl_wire import ORIGIN_MM, SETTINGS, Bench, Wired

from drivers.errors import ConfigError, DeviceFaultError, OutOfTravelError


def test_what_the_rig_file_expects_is_compared_and_named() -> None:
    bench = Bench("gnea", SETTINGS)
    with pytest.raises(ConfigError, match=r"\$130 \(travel of X\) is 35, the rig file expects 36"):
        bench.open({"$132": 28, "$130": 36})
    with pytest.raises(ConfigError, match=r"no setting \$999"):
        bench.open({"$999": 1})
    with pytest.raises(ConfigError, match="'acceleration'"):
        bench.open({"acceleration": 1})


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("$20", 0, r"\$20 is 0.*soft limits.*\$20=1"),
        ("$22", 0, r"\$22 is 0.*homing.*\$22=1"),
        ("$13", 1, r"\$13 is 1.*millimetres.*\$13=0"),
        ("$131", 0, r"\$131 \(Y\) is missing or zero"),
    ],
)
@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_controller_that_would_not_refuse_is_refused(dialect: str, key: str, value: float, complaint: str) -> None:
    settings = SETTINGS | {key: value}
    if key == "$22":
        settings["$20"] = 0
    with pytest.raises(ConfigError, match=complaint):
        Bench(dialect, settings).open()


def test_only_gnea_gets_its_report_mask_written_and_only_when_needed() -> None:
    bench = Bench("gnea", SETTINGS | {"$10": 1})
    controller, line = bench.open()
    assert b"$10=3\n" in line.written
    controller.close()
    controller, line = bench.open()
    assert b"$10=" not in line.written
    controller.close()
    controller, line = Bench("grblhal", SETTINGS).open()
    assert b"$10=" not in line.written
    controller.close()


@pytest.mark.parametrize("mask", [0, 2])
def test_a_controller_that_reports_work_positions_is_put_right_or_refused(mask: int) -> None:
    controller, line = Bench("gnea", SETTINGS | {"$10": mask}).open()
    assert b"$10=3\n" in line.written
    controller.home()
    controller.close()
    bench = Bench("grblhal", SETTINGS)
    bench.board.receive(b"$10=%d\n" % mask)
    bench.clock.sleep_s(0.1)
    with pytest.raises(ConfigError, match=rf"\$10 is {mask}.*\$10=3"):
        bench.open()


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_coarse_machine_with_a_long_travel(dialect: str) -> None:
    """250 steps/mm and 200 mm: every place within half a step, the floor and both ends of the travel reached."""
    coarse = {f"${first + axis}": value for first, value in ((100, 250), (130, 200)) for axis in range(3)}
    bench = Bench(dialect, SETTINGS | coarse)
    with bench.open(coarse)[0] as controller:
        controller.home()
        controller.set_floor(-33.3333)
        low, high = controller.travel.low_mm, controller.travel.high_mm
        assert low == pytest.approx((-175.0, -190.0, -33.333), abs=0.001)
        for target in ((high[0] - 0.5017, high[1] - 0.5, low[2]), (high[0] - 30.0013, high[1] - 7.7777, -5.5555)):
            controller.start_move(target, feed_mm_per_s=20.0)
            reached = controller.wait_until_idle(60.0).position_mm
            assert reached == pytest.approx(target, abs=0.0026)
        for index in range(30):  # steps shorter than one of the motor's
            controller.start_move((target[0] + 0.001 * index, *target[1:]), feed_mm_per_s=1.0)
        assert controller.wait_until_idle(5.0).queued_s == 0.0


def test_the_floor_of_a_host_that_was_killed_does_not_stay(on_wire: Wired) -> None:
    controller, _, bench = on_wire
    controller.set_floor(0.0)
    again, line = bench.open({"$132": 28, "$130": 35})
    assert b"$132=28\n" in line.written
    again.home()
    assert again.travel.low_mm[2] == pytest.approx(-8.0)
    again.set_floor(0.0)
    with pytest.raises(ConfigError, match=r"\$130 \(travel of X\) is 35, the rig file expects 36"):
        bench.open({"$132": 28, "$130": 36})
    # The refusal wrote nothing.
    with pytest.raises(ConfigError, match=r"\$132 \(travel of Z\) is 20, the rig file expects 19"):
        bench.open({"$132": 19, "$130": 35})


@pytest.mark.parametrize(("mask", "home_mm"), [(0, -0.5), (1, -34.5)])
def test_homing_directions(mask: int, home_mm: float) -> None:
    """The coordinates are negative wherever the switch is ($23), as long as the firmware sets no origin there."""
    bench = Bench("gnea", SETTINGS | {"$23": mask})
    bench.axes.x_switch_is_low = bool(mask)
    controller, _ = bench.open()
    controller.home()
    assert controller.status().position_mm[0] + ORIGIN_MM[0] == pytest.approx(home_mm, abs=0.002)
    assert controller.travel.low_mm == pytest.approx((-10.0, -30.0, -8.0))
    assert controller.travel.high_mm == pytest.approx((25.0, 10.0, 20.0))
    controller.close()


def test_a_floor_is_refused_where_z_homes_at_the_bottom() -> None:
    controller, _ = Bench("gnea", SETTINGS | {"$23": 4}).open()
    with pytest.raises(ConfigError, match=r"\$23"):
        controller.set_floor(0.0)
    controller.close()


def test_a_floor_above_the_tip_is_refused(on_wire: Wired) -> None:
    controller, _, _ = on_wire
    controller.start_move((24.0, 9.0, 12.0), feed_mm_per_s=20.0)
    controller.wait_until_idle(5.0)
    with pytest.raises(OutOfTravelError, match="above the tip"):
        controller.set_floor(13.0)


def test_a_setting_that_does_not_read_back_is_told(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.change = lambda text: b"$132=28.000\r\n" if text.startswith(b"$132=") else text
    with pytest.raises(DeviceFaultError, match=r"\$132 was written as 20 and reads back as 28"):
        controller.set_floor(0.0)
