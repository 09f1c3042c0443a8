"""The benchmark shows what the loop shows; what that costs is a ratio, and far below writing the record."""

from benchmarks.live_page import measure


def test_showing_costs_less_than_recording() -> None:
    figures = measure(400)
    assert figures["events"] == 400
    assert 0 < figures["ratio"] < 1.0
    assert 0 < figures["pictures_share"] < 0.2
