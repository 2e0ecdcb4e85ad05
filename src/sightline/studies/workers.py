"""Workers that run trials: local processes or a Dask cluster. Both have the interface of `concurrent.futures`."""

import logging
import os
import signal
import threading
from collections.abc import Generator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait

from sightline.errors import UnusableInputError
from sightline.studies.record import code_digest

# Matrices are small, so threads of the linear algebra cost more than they save.
_LINEAR_ALGEBRA = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_THREADS = (*_LINEAR_ALGEBRA, "NUMBA_NUM_THREADS")
PATIENCE_S = 10.0  # time limit for a scheduler's answer, and for its first worker [ours]


@dataclass(frozen=True)
class Workers:
    """An `executor` that runs `number` trials at a time. `lost`: exceptions of a future whose worker died."""

    executor: Executor
    number: int
    lost: tuple[type[BaseException], ...]


@contextmanager
def local_workers(number: int | None = None) -> Generator[Workers]:
    """Context of local worker processes, one thread each; default: one process per core."""
    from concurrent.futures.process import BrokenProcessPool

    number = number or os.cpu_count() or 1
    with _one_thread():  # the variables are read when a process first imports numpy
        pool = ProcessPoolExecutor(number, mp_context=get_context("spawn"), initializer=_settle)
        try:
            yield Workers(pool, number, (BrokenProcessPool,))
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def cluster_workers(address: str) -> Generator[Workers]:
    """Context of the workers of a Dask scheduler, which must have the same code. Raises UnusableInputError."""
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise UnusableInputError(
            "--scheduler needs the package distributed: pip install 'sightline[studies]'; without it, leave "
            "--scheduler out and the processes of this machine do the work"
        ) from None
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # our messages replace its tracebacks
    try:
        client = Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UnusableInputError(
            f"no scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`, and give "
            "the address that it prints"
        ) from error
    try:
        number = _refuse_other_code(client, address)
        yield Workers(client.get_executor(), number, (KilledWorker,))
    finally:
        client.close(timeout=PATIENCE_S)


def _refuse_other_code(client, address: str) -> int:
    """Return the number of trials that the cluster does at a time. Raises UnusableInputError if it has no workers, or
    if they have other code or use several threads for linear algebra."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError:
        raise UnusableInputError(
            f"the scheduler at {address} has no workers; start some with `dask worker {address}`"
        ) from None
    try:
        digests = client.run(code_digest)  # sent by name, so it raises if a worker has no such function
    except (ImportError, AttributeError):
        digests = {"all": None}
    other = [worker for worker, digest in digests.items() if digest != code_digest()]
    if other:
        raise UnusableInputError(
            f"workers of {address} have no Sightline or another version ({', '.join(other)}): their trials must not be "
            "mixed with these; install the same version there"
        )
    threaded = [worker for worker, one in client.run(one_threaded).items() if not one]
    if threaded:
        raise UnusableInputError(
            f"workers of {address} may do linear algebra on several threads ({', '.join(threaded)}), which changes the "
            f"last digits: start them with {'=1 '.join(_LINEAR_ALGEBRA)}=1, as `dask worker` does by itself"
        )
    return sum(client.nthreads().values())


def one_threaded() -> bool:
    """Whether this process uses one thread for linear algebra, so that results are bit-identical."""
    return all(os.environ.get(name) == "1" for name in _LINEAR_ALGEBRA)


def _settle() -> None:
    """Make a worker process ignore Ctrl-C and end with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


@contextmanager
def _one_thread() -> Generator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(before, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
