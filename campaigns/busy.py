"""The tests on a machine with all cores busy: `python -m campaigns.busy`. All must pass.

Twenty runs of the tests of robot, app and acquisition, three of all tests, and one of the first set with SIGINT
ignored, as a shell does for background processes. Finished runs are kept; the same command resumes a stopped run.
"""

import argparse
import json
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

ROOT = Path(__file__).parents[1]
TIMED = [
    "tests/robot",
    "tests/app",
    "tests/rehearsal",
    *(str(f.relative_to(ROOT)) for f in sorted((ROOT / "tests/case").glob("test_acquire*.py"))),
]
PLAN = {
    **{f"robot, app, acquisition {k + 1}": (TIMED, False) for k in range(20)},
    **{f"all {k + 1}": (["-n", "auto", "--dist", "loadfile", "--no-loadscope-reorder"], False) for k in range(3)},
    "SIGINT ignored": (TIMED, True),
}


def burn() -> None:
    """Keep one core busy until killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        sum(range(100_000))


@contextmanager
def busy_cores() -> Iterator[None]:
    """Run one busy process per core."""
    burning = [get_context("spawn").Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    for one in burning:
        one.start()
    try:
        yield
    finally:
        for one in burning:
            one.kill()


def run(where: list[str], ignoring_interrupts: bool) -> dict[str, object]:
    """Return duration, exit code and failed tests of one run."""
    started = time.monotonic()
    made = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *where],
        check=False, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=(lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)) if ignoring_interrupts else None,
    )  # fmt: skip
    failed = [line for line in made.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    told = made.stdout.splitlines()[-1:] or [made.stderr[-200:]]
    return {"code": made.returncode, "failed": failed, "told": told[0], "seconds": round(time.monotonic() - started)}


def main() -> int:
    """Run what is not finished; return 1 if a test failed in any run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/busy.jsonl"), help="finished runs")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    finished = {line["run"]: line for line in map(json.loads, lines)}
    console = Console()
    with busy_cores():
        for name, (where, ignoring) in PLAN.items():
            if name not in finished:
                finished[name] = {"run": name, **run(where, ignoring)}
                with options.out.open("a") as out:
                    out.write(json.dumps(finished[name]) + "\n")
            one = finished[name]
            console.print(f"{name}: {one['told']} ({one['seconds']} s)", *one["failed"], sep="\n  ", soft_wrap=True)
    bad = [name for name, one in finished.items() if one["code"] != 0]
    console.print(f"{len(finished)} runs, {len(bad)} with a failure")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
