"""The same runner on a Dask cluster."""

import logging
import sys
from collections.abc import Iterator
from importlib import import_module
from itertools import count
from pathlib import Path

import pytest
from tests.studies.small_study import SmallStudy

from sightline.errors import UnusableInputError
from sightline.studies.runs import run as run_module
from sightline.studies.runs.run import StudyRun

SEED, N = 5, 12
# What Dask itself warns of while it closes is none of ours.
pytestmark = [pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a scheduler with two workers, in threads of this process."""
    from distributed import LocalCluster

    with (
        pytest.MonkeyPatch.context() as patched,
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp://"
        ) as running,
    ):
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            patched.setenv(name, "1")  # as `dask worker` does
        yield running.scheduler_address


@pytest.mark.slow
def test_a_cluster_gives_the_same_result_and_goes_on_where_others_stopped(cluster: str, tmp_path: Path) -> None:
    StudyRun.open(SmallStudy(), 4, SEED, tmp_path).do(workers=1)
    run = StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    counted = []
    run.do(cluster, advance=lambda: counted.append(1))
    assert len(counted) == N - 4
    alone = StudyRun.open(SmallStudy(), N, SEED, tmp_path / "alone")
    alone.do(workers=1)
    assert run.result().document() == alone.result().document()


def test_workers_with_other_code_are_refused(cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    calls = count()
    monkeypatch.setattr(run_module, "code_digest", lambda: str(next(calls)))
    with pytest.raises(UnusableInputError, match="no Sightline or another version"):
        run.do(cluster)
    assert run.missing == list(range(N))


@pytest.mark.parametrize("threads", ["2", None])
def test_workers_with_threads_of_linear_algebra_are_refused(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: str | None
) -> None:
    if threads is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    else:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", threads)
    run = StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    with pytest.raises(UnusableInputError, match="linear algebra on several threads"):
        run.do(cluster)
    assert run.missing == list(range(N))


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what Dask logs elsewhere in a host program stays as it was."""
    import_module("distributed")  # it sets its loggers itself
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "tornado.application")]
    before = [(log.level, log.disabled, list(log.filters)) for log in loggers]
    monkeypatch.setattr(run_module, "PATIENCE_S", 0.5)
    run = StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(UnusableInputError, match=f"no scheduler answers at {address}"):
            run.do(address)
    assert [(log.level, log.disabled, list(log.filters)) for log in loggers] == before


def test_a_scheduler_without_workers_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(run_module, "PATIENCE_S", 0.5)
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address=None, protocol="tcp://") as empty,
        pytest.raises(UnusableInputError, match="has no workers"),
    ):
        StudyRun.open(SmallStudy(), N, SEED, tmp_path).do(empty.scheduler_address)


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UnusableInputError, match="pip install 'sightline\\[studies\\]'"):
        StudyRun.open(SmallStudy(), N, SEED, tmp_path).do("tcp://127.0.0.1:9")
