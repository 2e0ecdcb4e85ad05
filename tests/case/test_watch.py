"""A live image watched: why an image gave no view, the plan drawn in, frames dropped and counted, the alarm."""

import time
from dataclasses import dataclass, replace
from functools import cache
from threading import Event

import numpy as np
import pytest
from tests.detection.frame_images import FRAME, SIZE, beads, image

from sightline.calibration import BeadView, calibrate
from sightline.calibration.displacement import Displacement
from sightline.case.watch.analyser import (
    FOUND,
    HOUR,
    PROMISED_MM,
    REST_FRAMES,
    Alarm,
    LiveAnalyser,
    Watched,
    aged,
    limit_mm,
    quantiles,
)
from sightline.case.watch.live import Watch
from sightline.detection import Observations
from sightline.errors import SourceError, UnusableInputError
from sightline.from_images.pipeline import find_beads
from sightline.imaging import Radiograph
from sightline.planning import Trajectory
from sightline.planning.points.results import SpacePoints

ENTRY_END_MM = np.array([[-20.3, 11.2, -9.7], [22.1, -14.6, 13.4]])
NOISES = 3  # images of one scene; they take turns


@dataclass(frozen=True)
class Still:
    image: Radiograph
    stamped_s: float


@cache
def shown(x_mm: float = 0.0, noise: int = 0) -> Radiograph:
    return image(beads((x_mm, 0.0, 0.0)), 100 + noise)


EMPTY = Radiograph(np.full((SIZE, SIZE), 2000, np.uint16), 4095)


def trajectory() -> Trajectory:
    none = np.zeros(2)
    covariance = 0.04 * np.eye(6)
    return Trajectory(SpacePoints(ENTRY_END_MM.copy(), none, np.zeros(2, bool), none, covariance, None, none > -1))


def seen_by(analyser: LiveAnalyser, images: list[Radiograph]) -> list[Watched]:
    start = time.time()
    return [analyser.look(Still(one, start + k / 30), time.monotonic(), k + 1, 0) for k, one in enumerate(images)]


@cache
def planned_view() -> BeadView:
    return seen_by(LiveAnalyser(FRAME, None, ()), [shown()])[0].view


@pytest.fixture(scope="module")
def settled() -> tuple[LiveAnalyser, list[Watched]]:
    """An analyser that has found its rest position, and what it said on the way."""
    analyser = LiveAnalyser(FRAME, trajectory(), ())
    return analyser, seen_by(analyser, [shown(0.0, k % NOISES) for k in range(REST_FRAMES)])


@pytest.mark.parametrize("bright", [True, False])
def test_images_are_inverted_from_the_second_on_without_a_search(
    settled, monkeypatch: pytest.MonkeyPatch, bright: bool
) -> None:
    """Of a source that shows the balls bright, and of one that inverts its images."""
    searched = []
    monkeypatch.setattr(
        "sightline.case.watch.analyser.find_beads",
        lambda image: searched.append(image.is_inverted) or find_beads(image),
    )
    white = int(shown().white)
    images = [Radiograph(white - shown(0.0, k).pixels, white, is_inverted=False) for k in range(2)]
    images = images if bright else [image.inverted() for image in images]
    for watched, upright in zip(seen_by(LiveAnalyser(FRAME, None, ()), images), settled[1], strict=False):
        np.testing.assert_array_equal(watched.view.focal_point_mm, upright.view.focal_point_mm)
    assert searched == [not bright, True]


def test_the_plan_is_drawn_where_the_view_has_it(settled) -> None:
    last = settled[1][-1]
    ends = last.corridor.uv_px[[0, -1]]
    assert ends == pytest.approx(last.view.project(ENTRY_END_MM), abs=0.01)
    assert 0.05 < last.error_95_mm < 2.0
    assert LiveAnalyser(FRAME, None, ()).look(Still(shown(), time.time()), time.monotonic(), 1, 0).corridor is None


def test_each_image_gives_its_own_view_or_the_reason_why_it_has_none() -> None:
    first, empty, jumped = seen_by(LiveAnalyser(FRAME, None, ()), [shown(), EMPTY, shown(4.0)])
    assert (empty.view, empty.movement) == (None, None)
    assert "noise cannot be measured" in empty.reason
    assert "not be seen" in empty.note
    assert (first.reason, jumped.reason) == ("", "")
    assert np.linalg.norm(jumped.view.focal_point_mm - first.view.focal_point_mm) == pytest.approx(4.0, abs=0.5)


def test_a_shift_is_told_within_two_images_and_stays_told() -> None:
    analyser = LiveAnalyser(FRAME, trajectory(), [planned_view()])
    still = seen_by(analyser, [shown(0.0, k % NOISES) for k in range(4)])
    assert not any(w.moved for w in still)
    assert all(w.movement.able for w in still)
    first, second, third = seen_by(analyser, [shown(PROMISED_MM), shown(PROMISED_MM, 1), shown(0.0, 2)])
    assert first.movement.shift_mm == pytest.approx(PROMISED_MM, abs=5 * first.movement.sd_mm)
    assert (first.moved, second.moved, third.moved) == (False, True, True)
    assert "moved since planning" in second.movement.text
    analyser.rest()
    (after,) = seen_by(analyser, [shown(0.3, 2)])
    assert not after.moved
    assert after.note.startswith("finding the rest position")


def test_without_a_view_of_planning_the_first_half_second_is_rest(settled) -> None:
    analyser, said = settled
    assert [w.movement for w in said] == [None] * REST_FRAMES
    assert said[-1].note == "at rest"
    (following,) = seen_by(analyser, [shown(0.0, 1)])
    assert following.movement.since == "rest"
    assert following.movement.shift_mm < 5 * following.movement.sd_mm


def test_what_moves_while_rest_is_sought_is_no_rest() -> None:
    analyser = LiveAnalyser(FRAME, None, ())
    said = seen_by(analyser, [shown(0.0 if k < REST_FRAMES / 2 else 0.6, k % NOISES) for k in range(REST_FRAMES)])
    assert "hold still" in said[-1].note
    assert said[-1].movement is None


def displacement(x_mm: float, sd_mm: float = 0.01, rest_sd_mm: float = 0.0025) -> Displacement:
    own, rest = (sd**2 * np.eye(2)[None] for sd in (sd_mm, rest_sd_mm))
    return Displacement(np.array([[x_mm, 0.0]]), own, rest, 90)


def test_one_image_beyond_the_limit_is_no_alarm() -> None:
    alarm = Alarm(1, "rest")
    moved = [alarm.update(displacement(x)).moved for x in (0.0, 0.9, 0.0, 0.9, 0.0, 0.3, 0.3, 0.0)]
    assert moved == [False] * 6 + [True] * 2


def test_noise_that_hides_the_promised_shift_is_said() -> None:
    margin = PROMISED_MM / sum(quantiles(1))
    assert Alarm(1, "rest").update(displacement(0.0, 0.9 * margin, 0.0)).able
    noisy = Alarm(1, "rest").update(displacement(0.0, 1.1 * margin, 0.0))
    assert not noisy.able
    assert "too noisy" in noisy.text
    assert not Alarm(1, "rest").update(displacement(0.0, 0.9 * margin, 0.9 * margin)).able


@pytest.mark.parametrize("targets", [1, 2])
def test_the_limit_keeps_both_promises_at_the_most_noise_it_takes(targets: int) -> None:
    rng = np.random.default_rng(7)
    sd, hours = PROMISED_MM / sum(quantiles(targets)), 10
    noise = sd * rng.standard_normal((hours * HOUR, targets, 2))
    beyond = np.hypot(*np.moveaxis(noise, 2, 0)).max(axis=1) > limit_mm(targets)
    false = np.count_nonzero(beyond[1:] & beyond[:-1])
    assert false <= hours + 3 * np.sqrt(hours)  # one an hour
    moved = noise[: 2 * 20_000] + np.array([PROMISED_MM, 0.0])
    found = (np.hypot(*np.moveaxis(moved, 2, 0)).max(axis=1) > limit_mm(targets)).reshape(-1, 2).all(axis=1).mean()
    assert found > FOUND - 3 * np.sqrt(FOUND * (1 - FOUND) / 20_000)


def test_a_late_image_is_stale_and_has_no_overlay(settled) -> None:
    last = settled[1][-1]
    fresh, late = aged(last, last.came_s + 0.15), aged(last, last.came_s + 0.25)
    assert (fresh.stale, late.stale) == (False, True)
    assert fresh.corridor is not None
    assert late.corridor is None
    assert late.age_s == pytest.approx(0.25)


def test_an_image_grows_old_though_the_clock_is_set_back(settled, monkeypatch: pytest.MonkeyPatch) -> None:
    """A C-arm that shows nothing new: its last image must not look as new as ever."""
    source = Burst(1)
    with Watch(FRAME, source) as watch:
        came_s = watch.next(0, 30).came_s
        monkeypatch.setattr(time, "time", lambda: 0.0)
        monkeypatch.setattr(time, "monotonic", lambda: came_s + 60.0)
        assert watch.latest().stale
        assert watch.latest().age_s == pytest.approx(60.0)
        analyser = LiveAnalyser(FRAME, None, ())
        assert analyser.look(Still(shown(), 3600.0), came_s + 59.0, 1, 0).latency_s == pytest.approx(1.0)
        monkeypatch.undo()
        source.go_on.set()


class Burst:
    """Frames that come all at once, in groups: the next group when the one before was worked on."""

    def __init__(self, *groups: int) -> None:
        self.groups, self.go_on, self.closed = groups, Event(), False

    def __iter__(self):
        for count in self.groups:
            for k in range(count):
                yield Still(shown(0.0, k % NOISES), time.time())
            self.go_on.wait(30)
            self.go_on.clear()

    def close(self) -> None:
        self.closed = True


def test_frames_that_come_too_fast_are_dropped_and_counted_and_the_newest_wins() -> None:
    source = Burst(6, 1)
    with Watch(FRAME, source) as watch:
        newest = watch.next(5, 30)
        assert newest.number == 6
        worked_on_before = 1 if newest.dropped == 4 else 0
        assert newest.dropped + worked_on_before == 5
        source.go_on.set()
        following = watch.next(6, 30)
        assert (following.number, following.dropped) == (7, newest.dropped)
        assert not watch.ended
        source.go_on.set()
        assert watch.next(7, 30) is None
        assert watch.ended
        assert watch.fault is None
        assert watch.latest().number == 7
    assert source.closed


def test_a_source_that_fails_is_told_and_what_was_seen_stays() -> None:
    def failing():
        yield Still(shown(), time.time())
        raise SourceError("the source is gone; look at its cable")

    with Watch(FRAME, failing()) as watch:
        assert watch.next(1, 30) is None
        assert watch.ended
        assert "look at its cable" in watch.fault
        assert watch.latest().number == 1


def test_a_reference_of_another_frame_is_refused() -> None:
    view = planned_view()
    with pytest.raises(UnusableInputError, match="another frame"):
        Watch(FRAME, [], references=[replace(view, frame_key="other/1")])
    beads_of = view.posterior.beads
    seen = Observations(view.name, beads_of.ids, beads_of.uv_px, beads_of.covariance_px2)
    by_others = calibrate(seen, FRAME, method="polynomial")
    with pytest.raises(UnusableInputError, match="smooth"):
        Watch(FRAME, [], references=[by_others])
