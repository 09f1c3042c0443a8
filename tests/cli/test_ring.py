"""The gauge shows each point where the picture shows it."""

from cli.ring import DONE, HEIGHT, LEFT_OUT, MARKS, WIDTH, ring_gauge


def rows(completion: list[float | None], done: list[bool], lines: list[str] | None = None) -> list[str]:
    return ring_gauge(completion, done, lines or []).plain.splitlines()


def test_untouched_through_and_unknown_look_different_without_colour() -> None:
    nothing = "".join(rows([0.0] * 32, [False] * 32))
    almost = "".join(rows([0.99] * 32, [False] * 32))
    through = "".join(rows([1.0] * 32, [True] * 32))
    unknown = "".join(rows([None] * 32, [False] * 32))
    assert set(nothing) == {" ", MARKS[0]}
    assert set(almost) == {" ", MARKS[-1]}
    assert set(through) == {" ", DONE}
    assert set(unknown) == {" ", LEFT_OUT}


def test_point_n_is_at_theta_two_pi_which_is_down_and_point_n_quarter_is_right() -> None:
    last = [False] * 31 + [True]
    drawn = rows([0.0] * 32, last)
    assert DONE in drawn[HEIGHT - 1]
    quarter = [index == 7 for index in range(32)]
    drawn = rows([0.0] * 32, quarter)
    assert drawn[HEIGHT // 2][WIDTH - 1] == DONE


def test_the_middle_carries_the_words() -> None:
    drawn = rows([0.0] * 32, [False] * 32, ["0.21 mm", "45 000 rpm"])
    assert any("0.21 mm" in row for row in drawn)
