"""Work in parts: all of it is done, once, whatever the number of threads; an error comes through. Linear algebra in
one thread: results do not depend on the user's setting, which is back afterwards."""

import threading
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

import sightline as sl
from sightline.common import threads
from sightline.common.threads import one_blas_thread
from sightline.detection.csv_files import read_observations
from sightline.twin import render
from sightline.twin.objects.things import frame_scene


def _count(part: int, parts: int, done: np.ndarray) -> None:
    done[part::parts] += 1


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("length", [0, 1, 7, 100])
def test_every_row_is_done_once(monkeypatch: pytest.MonkeyPatch, count: int, length: int) -> None:
    monkeypatch.setattr(threads, "THREADS", count)
    done = np.zeros(length, dtype=int)
    threads.in_parts(_count, done)
    np.testing.assert_array_equal(done, 1)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_each_job_gives_its_own_result(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """A program that returns results in the order in which they came, or loses one, fails; so does a silent error."""
    monkeypatch.setattr(threads, "THREADS", count)
    jobs = [lambda k=k: 10 * k for k in range(30)]
    assert threads.at_once(*jobs) == [10 * k for k in range(30)]
    with pytest.raises(ZeroDivisionError):
        threads.at_once(lambda: 1, lambda: 1 // 0)


BLAS = ThreadpoolController().select(user_api="blas")


def _threads() -> set[int]:
    return {one["num_threads"] for one in BLAS.info()}


def _focal_point(threads_of_blas: int) -> bytes:
    seen = read_observations(Path(__file__).parent / "golden" / "observations.csv")["pa"]
    with BLAS.limit(limits=threads_of_blas):
        return sl.calibrate(seen, "gamma").focal_point_mm.tobytes()


def test_a_calibration_has_the_same_bits_however_many_threads_the_user_allows() -> None:
    assert _focal_point(4) == _focal_point(1)


def test_the_users_threads_are_back_after_an_estimate_and_after_an_error() -> None:
    with BLAS.limit(limits=3):
        with one_blas_thread:
            assert _threads() == {1}
        assert _threads() == {3}
        with pytest.raises(sl.SightlineError):
            sl.detect(np.zeros((64, 64)))
        assert _threads() == {3}


def test_a_part_in_another_thread_that_fails_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    """The calling thread works too; a program that forgets what became of its helpers would return in silence."""
    monkeypatch.setattr(threads, "THREADS", 2)
    caller, begun = threading.get_ident(), threading.Event()

    def fail_elsewhere(part: int, parts: int) -> None:
        if threading.get_ident() != caller:
            begun.set()
            raise ZeroDivisionError
        begun.wait(10)

    with pytest.raises(ZeroDivisionError):
        threads.in_parts(fail_elsewhere)


@pytest.mark.slow
def test_an_image_gives_the_same_bits_in_one_to_four_threads(monkeypatch: pytest.MonkeyPatch, setup) -> None:
    """A program whose sums, or whose order of beads, depend on how the parts are shared out fails."""
    rng = np.random.default_rng(5)
    image = render(setup, "pa", frame_scene(setup.true_frame), rng)
    frame, bits = sl.Frame.load("gamma"), set()
    for count in (1, 2, 3, 4):
        monkeypatch.setattr(threads, "THREADS", count)
        threads._pool.cache_clear()  # the next count takes its own
        beads = sl.detect(image)
        assert len(beads) > 80
        view = sl.calibrate(sl.label(beads, frame), frame)
        bits.add(beads.uv_px.tobytes() + beads.covariance_px2.tobytes() + view.focal_point_mm.tobytes())
    threads._pool.cache_clear()
    assert len(bits) == 1
