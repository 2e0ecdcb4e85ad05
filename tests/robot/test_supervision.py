"""What supervision notices in forces, and what stops it."""

import numpy as np
import pytest

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.control.supervision import (
    MAX_GAP_S,
    EventKind,
    ForceFilter,
    Supervision,
    SupervisionEvent,
    depth_limit,
)

DT, FEED = 0.005, 1.0  # 200 Hz, 60 mm/min
# Force against depth: air, a cortex of 4 mm, cancellous bone, a shell of 1 mm, air.
AT_MM = np.array([-3.0, 0.0, 0.8, 4.0, 4.8, 40.0, 40.6, 41.4, 42.0, 50.0])
FORCE_N = np.array([0.0, 0.0, 30.0, 30.0, 1.5, 1.5, 20.0, 20.0, 0.0, 0.0])


def drilled(forces=FORCE_N, at=AT_MM, planned=100.0, limit=100.0, seed=1, noise=1.0) -> list[SupervisionEvent]:
    rng, watch = np.random.default_rng(seed), Supervision(planned, limit)
    depth = np.arange(at[0], at[-1], FEED * DT)
    force = np.interp(depth, at, forces)
    force = force + noise * np.hypot(0.1 * force, 0.3) * rng.standard_normal(len(depth))
    return [one for k in range(len(depth)) for one in watch.step(k * DT, depth[k], force[k])]


@pytest.mark.parametrize("seed", range(5))
def test_each_cortex_is_entered_and_left_once_and_in_time(seed):
    found = drilled(seed=seed)
    assert [one.event for one in found] == [
        EventKind.CONTACT, EventKind.CORTEX, EventKind.BREAK_THROUGH, EventKind.CORTEX, EventKind.BREAK_THROUGH,
    ]  # fmt: skip
    contact, entry, left, shell, out = (one.depth_mm for one in found)
    assert 0.0 < contact < 0.2
    assert contact < entry < 0.5
    assert 4.2 < left < 4.8
    assert 40.0 < shell < 40.6
    assert 41.5 < out < 42.0


@pytest.mark.parametrize("seed", range(5))
def test_a_plateau_of_uneven_bone_is_left_by_nobody(seed):
    at = np.arange(0.0, 40.0, 0.5)
    uneven = 25 + 4 * np.random.default_rng(100 + seed).standard_normal(len(at))
    forces, places = np.concatenate([[0, 0], uneven]), np.concatenate([[-3.0, -0.5], at])
    assert EventKind.BREAK_THROUGH not in [one.event for one in drilled(forces, places, seed=seed)]


def test_cancellous_bone_is_a_contact_but_no_cortex():
    found = drilled(np.array([0.0, 0.0, 1.5, 1.5]), np.array([-3.0, 0.0, 1.0, 30.0]))
    assert [one.event for one in found] == [EventKind.CONTACT]


def test_planned_depth_is_said_once_and_limits_in_every_cycle():
    found = drilled(np.array([0.0, 0.0]), np.array([0.0, 10.0]), planned=5.0, limit=9.0)
    assert [one.event for one in found].count(EventKind.DEPTH) == 1
    assert found[0].event is EventKind.DEPTH
    assert found[0].depth_mm == pytest.approx(5.0, abs=0.006)
    assert [one.event for one in found].count(EventKind.DEPTH_LIMIT) == pytest.approx(200, abs=1)


def test_too_much_force_is_said():
    found = drilled(np.array([0.0, 0.0, 120.0, 120.0]), np.array([0.0, 5.0, 5.3, 6.0]))
    first = next(one for one in found if one.event is EventKind.FORCE_LIMIT)
    assert 5.15 < first.depth_mm < 5.4
    assert 80.0 < first.force_n < 100.0


def test_samples_that_say_nothing_stop_the_drilling():
    for depth, force, later in (
        (np.nan, 1.0, DT),
        (1.0, np.inf, DT),
        (1.0, 1.0, 0.0),
        (1.0, 1.0, MAX_GAP_S + 0.01),
    ):
        watch = Supervision(10.0, 20.0)
        watch.step(0.0, 0.0, 0.0)
        with pytest.raises(UnusableInputError):
            watch.step(later, depth, force)


def test_a_plan_beyond_the_depth_limit_is_refused():
    with pytest.raises(RobotRefusedError, match="depth limit"):
        Supervision(20.0, 19.9)
    with pytest.raises(RobotRefusedError, match="depth limit"):
        Supervision(np.nan, 20.0)
    assert depth_limit(85.0, 1.2) == pytest.approx(83.8)
    for distance, error in ((1.0, 1.2), (np.nan, 1.0), (50.0, np.nan), (50.0, -1.0)):
        with pytest.raises(RobotRefusedError, match="no depth is safe"):
            depth_limit(distance, error)


def test_the_filter_is_as_sure_as_it_says():
    """Of a force that wanders as the filter assumes; the mean squared normalised error of force and rate is 1."""
    rng = np.random.default_rng(4)
    wander = np.linalg.cholesky(25.0**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
    squares = []
    for _ in range(40):
        watch, force, rate = ForceFilter(), 20.0, 0.0
        for k in range(300):
            if k:
                step = wander @ rng.standard_normal(2)
                force, rate = force + DT * rate + step[0], rate + step[1]
            watch.add(k * DT, force + np.hypot(0.1 * force, 0.3) * rng.standard_normal())
        squares.append((watch.rate_n_s - rate) ** 2 / (watch.rate_n_s / watch.rate_sigma) ** 2)
    assert abs(np.mean(squares) - 1) < 0.67  # 3 s.d. of 40 numbers
