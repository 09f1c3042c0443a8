"""`--fault`: where it is taken, and where it is refused before anything moves."""

from pathlib import Path

import pytest
from mill_command import mill


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "--rig", "rig.toml", "--fault", "camera.off"], "no fault is planted on a rig"),
        (["doctor", "--rig", "rig.toml", "--fault", "can.silent"], "no fault is planted on a rig"),
        (["run", "--emulate", "--fault", "camera.gone"], "no fault 'camera.gone'; there are camera.stuck"),
        (["run", "--emulate", "--fault", "camera.slow=9 s"], "needs a number from 0.01 to 5, in s"),
        (["doctor", "--emulate", "--fault", "vision.nan"], "belongs to `mill run --emulate`"),
        (["emulate", "--fault", "vision.low=0.7:arc"], "not of the bench"),
        (["experiment", "milling", "--fault", "motion.scale_y=2"], "there are motion.alarm"),
    ],
)
def test_a_fault_that_cannot_be_planted_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert mill(*words) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert says in said[-1]
    assert list(tmp_path.iterdir()) == []
