"""The benchmark decides what the loop decides; how fast that is, no test asks."""

from benchmarks.planner_step import PERIOD_S, measure


def test_it_decides_with_new_evidence_and_without():
    figures = measure(12, 5)
    assert (figures["points"], figures["rounds"]) == (12, 5)
    assert 0 < figures["new_evidence_ms_50"] <= figures["new_evidence_ms_99"]
    assert figures["none_ms_50"] > 0
    assert figures["share_of_the_period_p99"] == figures["new_evidence_ms_99"] / (1000 * PERIOD_S)
