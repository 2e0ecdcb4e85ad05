"""Motion of the joints: within limits, together, exactly from start to end."""

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.robot.control.course import Move

SPEED, ACCELERATION = np.array([20.0, 20.0, 0.17, 0.17, 20.0]), np.array([400.0, 400.0, 3.5, 3.5, 400.0])


def drawn(seed: int) -> Move:
    rng = np.random.default_rng(seed)
    scale = np.array([30.0, 30.0, 0.4, 0.4, 60.0]) * 10.0 ** rng.uniform(-4, 0)  # also too short to reach full speed
    start = rng.uniform(-1, 1, 5) * scale
    return Move(start, start + rng.uniform(-1, 1, 5) * scale, SPEED, ACCELERATION, begun_s=3.7)


@pytest.mark.parametrize("seed", range(8))
def test_it_keeps_its_limits_and_one_of_them_is_met(seed):
    move = drawn(seed)
    t = 3.7 + np.linspace(0, move.duration_s, 4001)
    positions, velocities = (np.array(part) for part in zip(*(move.at(x) for x in t), strict=True))
    assert (np.abs(velocities) <= SPEED * (1 + 1e-9)).all()
    accelerations = np.diff(velocities, axis=0) / (t[1] - t[0])
    assert (np.abs(accelerations) <= ACCELERATION * (1 + 1e-6)).all()
    assert np.abs(accelerations / ACCELERATION).max() > 0.999  # no slower than it must
    # Position and velocity agree.
    middle = (velocities[1:] + velocities[:-1]) / 2 * (t[1] - t[0])
    assert np.allclose(np.diff(positions, axis=0), middle, atol=1e-4 * np.ptp(positions, axis=0).max())


@pytest.mark.parametrize("seed", range(5))
def test_it_is_straight_and_ends_where_it_should(seed):
    move = drawn(seed)
    assert np.allclose(move.at(0.0)[0], move.start)
    assert np.allclose(move.at(1e9)[0], move.end)
    assert (move.at(1e9)[1] == 0).all()
    share = (move.at(3.7 + 0.37 * move.duration_s)[0] - move.start) / (move.end - move.start)
    assert np.ptp(share) < 1e-9


def test_no_way_takes_no_time():
    move = Move(np.ones(5), np.ones(5), SPEED, ACCELERATION, 0.0)
    assert move.duration_s == 0
    assert (move.at(0.0)[0] == 1).all()
    assert (move.at(0.0)[1] == 0).all()


def test_what_is_no_number_is_refused():
    with pytest.raises(UnusableInputError, match="finite"):
        Move(np.full(5, np.nan), np.ones(5), SPEED, ACCELERATION, 0.0)
