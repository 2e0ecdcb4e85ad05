"""Work in parts: all of it is done, once, whatever the number of threads; an error comes through."""

import numpy as np
import pytest

from sightline import threads


def _count(part: int, parts: int, done: np.ndarray) -> None:
    done[part::parts] += 1


def _fail(part: int, parts: int) -> None:
    if part == parts - 1:
        raise ZeroDivisionError


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("length", [0, 1, 7, 100])
def test_every_row_is_done_once(monkeypatch: pytest.MonkeyPatch, count: int, length: int) -> None:
    monkeypatch.setattr(threads, "THREADS", count)
    done = np.zeros(length, dtype=int)
    threads.in_parts(_count, done)
    np.testing.assert_array_equal(done, 1)


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_in_a_part_is_raised(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(threads, "THREADS", count)
    with pytest.raises(ZeroDivisionError):
        threads.in_parts(_fail)
