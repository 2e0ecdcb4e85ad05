"""The pose of a body of balls: its covariance by sampling, and no wrong pose where balls are hidden or look alike."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.planning.test_many import COVARIANCE, MATRICES, _pixels

import sightline as sl
from sightline.detection import Detections
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.planning.points.body import EXCHANGED, HIDDEN, OTHER, BallBody, BodyFinder, BodyPose

SD_PX, SD_MM = 0.1, 0.03
BALLS_MM = np.array([[0.0, 0.0, 0.0], [17.3, 2.1, -1.4], [4.8, 21.9, 3.3], [-6.2, 8.7, 14.1]])
BODY = BallBody(("a", "b", "c", "d"), BALLS_MM, SD_MM**2 * np.eye(12))


def _views(errors: list[np.ndarray] | None = None) -> list[sl.CalibratedView]:
    errors = errors or [np.zeros((3, 4))] * 2
    return [
        sl.view_from_matrix(m + e, c, n) for m, e, c, n in zip(MATRICES[:2], errors, COVARIANCE[:2], "ab", strict=True)
    ]


def _seen(
    rng: np.random.Generator, xyz_mm: np.ndarray, hidden: tuple[int, ...] = (), view: int = 1
) -> list[Detections]:
    """Both images of balls, in any order, one without the hidden ones."""
    found = []
    for k, matrix in enumerate(MATRICES[:2]):
        kept = np.array([i for i in rng.permutation(len(xyz_mm)) if k != view or i not in hidden])
        uv = _pixels(matrix, xyz_mm[kept]) + rng.normal(0.0, SD_PX, (len(kept), 2))
        covariance = np.repeat(SD_PX**2 * np.eye(2)[None], len(kept), axis=0)
        found.append(
            Detections(uv, np.full(len(kept), 5.0), covariance, ("ball",) * len(kept), np.ones(len(kept)), (1024, 1024))
        )
    return found


def _pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_components(
        rng.uniform(-20.0, 20.0, 3), Rotation.random(random_state=rng.integers(1 << 30))
    )


def test_poses_err_as_stated() -> None:
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(60):
        errors = [rng.normal(0.0, np.sqrt(np.diag(c))).reshape(3, 4) for c in COVARIANCE[:2]]
        truth = _pose(rng)
        built = BALLS_MM + rng.normal(0.0, SD_MM, BALLS_MM.shape)
        found = BodyFinder(_views(errors), BODY).find(_seen(rng, truth.apply(built)))
        if isinstance(found, str):  # a gap or the fit beyond 99.9 %
            continue
        turn = (truth.rotation * found.pose.rotation.inv()).as_rotvec()
        off = np.concatenate([turn, truth.apply(BALLS_MM).mean(axis=0) - found.centre_mm])
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert len(squares) >= 57
    # The mean of 60 chi-squares with 6 degrees of freedom has a s.d. of 0.45.
    assert np.mean(squares) == pytest.approx(6.0, abs=1.6)


def test_no_pose_where_a_ball_is_hidden_moved_or_replaced() -> None:
    rng = np.random.default_rng(6)
    finder = BodyFinder(_views(), BODY)
    for _ in range(10):
        xyz = _pose(rng).apply(BALLS_MM)
        assert finder.find(_seen(rng, xyz, hidden=(2,))) == HIDDEN
        moved = xyz.copy()
        moved[3] += Rotation.random(random_state=rng.integers(1 << 30)).apply([1.5, 0.0, 0.0])
        assert finder.find(_seen(rng, moved)) == OTHER
        stray = np.concatenate([xyz, [rng.uniform(-30.0, 30.0, 3)]])
        assert finder.find(_seen(rng, stray, hidden=(0,))) == OTHER
        truth = _pose(rng)
        among = np.concatenate([truth.apply(BALLS_MM), rng.uniform(-40.0, 40.0, (6, 3))])
        found = finder.find(_seen(rng, among))
        assert isinstance(found, BodyPose)
        assert (truth.rotation * found.pose.rotation.inv()).magnitude() < 0.03


def test_a_mirror_image_does_not_fit_and_alike_balls_are_not_told_apart() -> None:
    rng = np.random.default_rng(7)
    finder = BodyFinder(_views(), BODY)
    assert finder.find(_seen(rng, BALLS_MM * [1.0, 1.0, -1.0])) == OTHER
    triangle = 12.0 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])
    alike = BallBody(("a", "b", "c"), triangle, SD_MM**2 * np.eye(9))
    assert BodyFinder(_views(), alike).find(_seen(rng, _pose(rng).apply(triangle))) == EXCHANGED


def test_a_body_is_learnt_where_both_images_match_one_to_one() -> None:
    rng = np.random.default_rng(9)
    finder = BodyFinder(_views())
    first, second = _pose(rng), _pose(rng)
    assert "one to one" in str(finder.find(_seen(rng, first.apply(BALLS_MM), hidden=(1,))))
    assert isinstance(finder.find(_seen(rng, first.apply(BALLS_MM))), BodyPose)
    found = finder.find(_seen(rng, second.apply(BALLS_MM)))
    assert isinstance(found, BodyPose)
    moved = second * first.inv()
    assert (moved.rotation * found.pose.rotation.inv()).magnitude() < 0.03
    np.testing.assert_allclose(found.centre_mm, second.apply(BALLS_MM).mean(axis=0), atol=0.3)


def test_what_determines_no_pose_is_refused() -> None:
    for xyz in (BALLS_MM[:2], BALLS_MM * 1e-3, np.outer([0.0, 10.0, 25.0], [1.0, 2.0, 0.5])):
        with pytest.raises(UnusableInputError, match="give 3 or more, in mm"):
            BallBody(tuple("abcd"[: len(xyz)]), xyz, np.eye(3 * len(xyz)))
    with pytest.raises(ErrorUnknownError):
        BodyFinder([sl.view_from_matrix(m, None, n) for m, n in zip(MATRICES[:2], "ab", strict=True)])
