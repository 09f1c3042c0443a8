"""The damper: the paper's formula in its middle, bounds at its ends."""

from itertools import pairwise

import pytest

from milling.job import Job
from milling.planner import policy_for


@pytest.mark.parametrize("feed", [1.0, 5.0])
def test_default_is_damped_and_bounded(feed: float) -> None:
    job = Job(feed_mm_s=feed)
    policy = policy_for(job)
    bites = [policy.bite_mm(k / 100) for k in range(101)]
    full_mm = min(job.bite_mm, job.removal_rate_mm2_s / job.feed_mm_s)
    assert bites[0] == full_mm
    assert all(later <= earlier for earlier, later in pairwise(bites))
    assert all(0 < bite <= full_mm for bite in bites)
    assert policy.guarded
    assert not policy.flat_start


def test_a_proportional_damper_alone_never_arrives() -> None:
    """80 um bites on 400 um of bone, 17 laps: about 10 um are left, which is why policy default keeps a least bite."""
    left = 0.4
    for _ in range(17):
        left -= 0.08 * (left / 0.4)
    assert left == pytest.approx(0.009, abs=0.001)


@pytest.mark.parametrize("feed", [0.5, 5.0])
def test_a_full_bite_removes_no_more_than_area_volume_and_depth_allow(feed: float) -> None:
    job = Job(feed_mm_s=feed)
    policy = policy_for(job)
    for depth_mm in (0.0, 0.02, 0.2, 0.5):
        bite_mm = policy.bite_mm(0.0, depth_mm=depth_mm)
        width_mm = 2 * (depth_mm * (1.0 - depth_mm)) ** 0.5
        assert bite_mm <= job.bite_mm
        assert bite_mm * feed <= job.removal_rate_mm2_s + 1e-12
        assert bite_mm * feed * width_mm <= 0.056 + 1e-12
    assert policy_for(Job()).bite_mm(0.0, depth_mm=0.5) == pytest.approx(0.056 / 5)


def test_default_arrives() -> None:
    policy, left = policy_for(Job()), 0.4
    for _ in range(45):
        left -= policy.bite_mm(1 - max(left, 0.0) / 0.4)
    assert left < 0


def test_paper_is_the_formula_and_done_at_095() -> None:
    job = Job(policy="paper")
    policy = policy_for(job)
    assert policy.bite_mm(0.5) == pytest.approx(policy.bite_mm(0.0) / 2)
    assert policy.bite_mm(0.949) > 0
    assert policy.bite_mm(0.95) == 0.0
    assert not policy.guarded
    assert policy.bite_mm(0.0) <= job.bite_mm


def test_previous_is_paper_from_a_flat_start() -> None:
    paper, previous = policy_for(Job(policy="paper")), policy_for(Job(policy="previous"))
    assert previous.flat_start
    assert not paper.flat_start
    assert previous.bite_mm(0.3) == paper.bite_mm(0.3)
