"""What people read: one line, whole words, commands in place of calls."""

import pytest

from cli.output import columns, for_people
from drivers.errors import DeviceError


@pytest.mark.parametrize(
    ("told", "read"),
    [
        (
            "in state Door, in which\nnothing moves; then home()",
            "in state Door, in which nothing moves; then `mill jog --home`",
        ),
        ("still moving after 30 s; hold() or flush() stops it", "still moving after 30 s; `mill stop` stops it"),
        ("no standstill; halt() stops at once", "no standstill; `mill stop` stops at once"),
        ("halted by halt()", "halted by halt()"),
    ],
)
def test_a_next_step_that_is_a_call_becomes_a_command(told: str, read: str) -> None:
    assert for_people(DeviceError(told)) == read


def test_columns_are_as_wide_as_their_widest_and_empty_ones_are_left_out() -> None:
    assert columns(("a", "none", "b"), [("1", "", "x" * 200), ("12345", "", "")]) == [
        "a      b",
        "1      " + "x" * 200,
        "12345",
    ]
