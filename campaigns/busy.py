"""The tests on a machine with all cores busy: `python -m campaigns.busy`. All must pass.

Twenty runs of the tests of robot, app and acquisition, three of all tests, and one of the first set with SIGINT
ignored, as a shell does for background processes. Finished runs are kept; the same command resumes a stopped run.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console

from campaigns.campaign import Finished

ROOT = Path(__file__).parents[1]
ACQUIRE = (str(file.relative_to(ROOT)) for file in sorted((ROOT / "tests/case").glob("test_acquire*.py")))
TIMED = ["tests/robot", "tests/app", "tests/rehearsal", *ACQUIRE]
PLAN = {
    **{f"robot, app, acquisition {k + 1}": TIMED for k in range(20)},
    **{f"all {k + 1}": ["-n", "auto", "--dist", "loadfile", "--no-loadscope-reorder"] for k in range(3)},
    "SIGINT ignored": TIMED,
}


def ignore_interrupts() -> None:
    """Ignore SIGINT in this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def burn() -> None:
    """Keep one core busy until killed."""
    ignore_interrupts()
    while True:
        sum(range(100_000))


@contextmanager
def busy_cores() -> Iterator[None]:
    """Run one busy process per core."""
    burning = [get_context("spawn").Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    for process in burning:
        process.start()
    try:
        yield
    finally:
        for process in burning:
            process.kill()


def run(name: str) -> dict[str, object]:
    """Return duration, exit code and failed tests of one run."""
    started = time.monotonic()
    made = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *PLAN[name]],
        check=False, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=ignore_interrupts if name == "SIGINT ignored" else None,
    )  # fmt: skip
    lines = made.stdout.splitlines() or [made.stderr[-200:]]
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return {"code": made.returncode, "failed": failed, "last": lines[-1], "seconds": round(time.monotonic() - started)}


def main() -> int:
    """Run what is not finished; return 1 if a test failed in any run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/busy.jsonl"), help="finished runs")
    finished, console = Finished(parser.parse_args().out), Console()
    with busy_cores():
        for name in PLAN:
            if name not in finished:
                finished.add(name, **run(name))
            made = finished[name]
            console.print(f"{name}: {made['last']} ({made['seconds']} s)", *made["failed"], sep="\n  ", soft_wrap=True)
    bad = sum(made["code"] != 0 for made in finished.values())
    console.print(f"{len(finished)} runs, {bad} with a failure")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
