"""Readings that are kept and drawn from: what a donor read where it was cut as deep."""

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from firmware_sim.bench import Bench
from firmware_sim.specimen import draw_specimen
from studies.perception import KEPT, Donor, Readings, donors, main
from studies.ring_truth import UNTOUCHED_MM, RingTruth
from studies.statistical import TIP_SIGMA_PX, NumberEyes


class Told:
    """A truth that says what it is told."""

    def __init__(self) -> None:
        self.excess = np.zeros(4)

    def excess_mm(self) -> np.ndarray:
        return self.excess


def rows_of(completion_at: dict[float, float], points: int = 4) -> np.ndarray:
    rows = [(point, x, c, min(1.0, c + 0.05)) for point in range(points) for x, c in completion_at.items()]
    return np.array(rows, np.float32)


def test_a_kept_reading_is_one_that_was_made() -> None:
    truth = Told()
    readings = Readings(truth, [])
    for step in range(50):
        truth.excess = np.full(4, -0.3 + 0.005 * step)
        visible = np.array([True, True, True, step % 2 == 0])
        readings.add(np.full(4, 0.01 * step), np.full(4, 0.01 * step + 0.05), visible)
    rows = readings.condensed()
    assert set(rows[:, 0]) == {0.0, 1.0, 2.0, 3.0}
    assert np.allclose(rows[:, 1], -0.3 + 0.5 * rows[:, 2], atol=1e-6)
    assert (rows[:, 0] == 3).sum() < (rows[:, 0] == 0).sum()


def test_no_place_is_kept_more_often_than_enough() -> None:
    readings = Readings(Told(), [])
    for step in range(100):
        readings.add(np.full(4, step / 100), np.ones(4), np.ones(4, bool))
    assert len(readings.condensed()) == 4 * KEPT


def test_a_donor_lends_what_it_read_at_the_same_depth() -> None:
    donor = Donor(rows_of({-0.3: 0.2, -0.1: 0.6, 0.0: 0.9, 0.03: 0.99}))
    rng = np.random.default_rng(0)
    completion, upper = donor.read(np.array([0.0, 0.3, 0.6, 0.9]), np.array([-0.3, -0.1, 0.001, 0.03]), rng)
    assert completion == pytest.approx([0.2, 0.6, 0.9, 0.99], abs=1e-6)
    assert upper == pytest.approx([0.25, 0.65, 0.95, 1.0], abs=1e-6)


def test_untouched_bone_reads_as_untouched() -> None:
    donor = Donor(rows_of({-0.3: 0.2, 0.0: 0.9}))
    completion, _ = donor.read(np.array([0.5]), np.array([-UNTOUCHED_MM]), np.random.default_rng(0))
    assert completion == [0.0]


def test_what_a_donor_got_wrong_at_its_deepest_goes_on_beyond() -> None:
    rng = np.random.default_rng(0)
    blind = Donor(rows_of({-0.3: 0.2, 0.01: 0.7}))
    sharp = Donor(rows_of({-0.3: 0.2, 0.01: 0.99}))
    at, beyond = np.array([0.0]), np.array([0.03])
    assert blind.read(at, beyond, rng)[0] < 0.99
    assert sharp.read(at, beyond, rng)[0] >= 0.99


def test_a_missing_file_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"python -m studies\.perception"):
        donors(tmp_path / "none.npz")
    with pytest.raises(SystemExit, match="mill experiment milling"):
        main([str(tmp_path)])


def test_runs_of_a_folder_become_donors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in "ab":
        np.save(tmp_path / f"mouse-{name}.readings.npy", rows_of({-0.3: 0.2, 0.0: 0.9}))
    main([str(tmp_path), "--out", str(tmp_path / "kept.npz")])
    assert "2 runs, 16 readings" in capsys.readouterr().out
    assert len(donors(tmp_path / "kept.npz")) == 2


def test_shipped_readings_grow_with_depth() -> None:
    rng, at = np.random.default_rng(0), np.arange(32) / 32
    for donor in donors():
        shallow, _ = donor.read(at, np.full(32, -0.2), rng)
        deep, _ = donor.read(at, np.full(32, 0.03), rng)
        assert deep.mean() > shallow.mean() + 0.3


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(draw_specimen(7))


def test_the_truth_of_a_ring_is_where_the_ball_was(bench: Bench) -> None:
    middle = np.array(bench.specimen.skull.center_mm[:2])
    angles = np.arange(16) * 2 * np.pi / 16
    xy = middle + 2.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    skull = bench.machine.skull
    points = np.column_stack([xy, skull.grid.sample(skull.outer_z, xy[:, 0], xy[:, 1])])
    ring = RingTruth(bench, bench.microscope.eyes[0].project(points))
    assert np.abs(ring.xy_mm - xy).max() < 0.02
    assert (ring.excess_mm() == -UNTOUCHED_MM).all()
    bench.machine.carve(xy, 0.2)
    before = ring.excess_mm()
    bench.machine.carve(xy, 0.25)
    assert ring.excess_mm() - before == pytest.approx(np.full(16, 0.05), abs=0.005)
    bench.machine.restore_bone()


def test_pictures_of_numbers_hold_what_full_pixels_would_show(bench: Bench) -> None:
    eyes = NumberEyes(bench, [Donor(rows_of({-0.3: 0.2, 0.0: 0.9}, 32))], seed=3)
    bench.machine.set_tip((5.0, -10.0, 4.0))
    true_px = np.array(list(bench.truth()["ball_px"].values()))
    left, right = eyes.render(1.0)
    assert left.shape == (540, 960, 3)
    assert not np.array_equal(left, eyes.render(1.05)[0]), "a picture is never the same twice"
    found = np.array([[[tip.x_px, tip.y_px] for tip in map(eyes.find_tip, (left, right))] for _ in range(400)])
    assert found.mean(axis=0) == pytest.approx(true_px, abs=0.1)
    assert found.std(axis=0) == pytest.approx(np.array([TIP_SIGMA_PX] * 2), rel=0.15)
    bregma, _ = eyes.find_landmarks(left)
    assert np.hypot(bregma.x_px - bench.microscope.labels().bregma_px[0][0], 0.0) < 5.0


def test_a_picture_from_before_the_ring_tells_nothing_of_it(bench: Bench) -> None:
    eyes = NumberEyes(bench, [Donor(rows_of({-0.3: 0.2, 0.0: 0.9}, 32))], seed=3)
    early, _ = eyes.render(1.0)
    ring = eyes.over(np.full((12, 2), 300.0) + np.arange(24).reshape(12, 2), 8.0, reference=None)
    assert not ring.read(early).visible.any()
    assert ring.read(eyes.render(1.1)[0]).visible.all()
