"""The tests, and runs of the robot, on a machine with all cores busy: `python -m campaigns.busy [robot]`.

Twenty runs of the tests of robot, app and acquisition, three of all tests, and one of the first set with SIGINT
ignored, as a shell does for background processes; all must pass. `robot`: 500 dry runs and 100 drillings in air. A dry
run is that of `sightline robot check`, which requires that real silence of the client stops the wire; none may end by a
false one.
Finished runs are kept; the same command resumes a stopped run.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console
from scipy.spatial.transform import RigidTransform

from campaigns.campaign import Finished
from sightline.cli.robot.commands import SERIAL
from sightline.errors import SightlineError
from sightline.rehearsal.operation import calibrated_robot
from sightline.robot.control.states import State
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.examination import ConformanceVerdict, Examination

ROOT = Path(__file__).parents[1]
ACQUIRE = (str(file.relative_to(ROOT)) for file in sorted((ROOT / "tests/case").glob("test_acquire*.py")))
TIMED = ["tests/robot", "tests/app", "tests/rehearsal", *ACQUIRE]
ALL = ["-n", "auto", "--dist", "loadfile", "--no-loadscope-reorder"]
AHEAD_MM = 125.0  # to the end of a bare target, whose wire is 95 mm: its entry is 30 mm ahead
Run = Callable[[], list[str]]  # returns what failed


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


def tested(words: list[str], before: Callable[[], None] | None = None) -> list[str]:
    """Return the failed tests of one run."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    single = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    made = subprocess.run(
        command, check=False, cwd=ROOT, capture_output=True, text=True, env=single, preexec_fn=before
    )  # fmt: skip
    failed = [line for line in made.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed or ([f"exit code {made.returncode}: {made.stderr[-200:]}"] if made.returncode else [])


@contextmanager
def robot_in_air() -> Iterator[int]:
    """Yield the port of a simulated robot in a separate process."""
    command = [sys.executable, "-m", "sightline", "robot", "serve", "--attached", "--port", "0", "--quiet"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        yield json.loads(process.stdout.readline())["port"]
        process.stdin.close()


def dry_run() -> list[str]:
    """Return the steps of a dry run that failed."""
    with robot_in_air() as port, Examination("127.0.0.1", port, SERIAL) as robot:
        return [f"{s.name}: {s.seen}" for s in robot.dry_run() if s.verdict is not ConformanceVerdict.PASSED]


def drilling() -> list[str]:
    """Drill through air to the tip; return why it ended."""
    try:
        with robot_in_air() as port, RobotClient(port=port) as robot:
            robot.start_up()
            q, manipulator = robot.joints()[0], calibrated_robot().manipulator
            registration = manipulator.T_mcs_cfcs(q)
            robot.calibrate(registration)
            wire = registration.inv() * manipulator.T_mcs_tool(q)
            robot.aim(wire * RigidTransform.from_translation([0.0, 2.0, AHEAD_MM]))
            robot.align()
            while robot.drill() != State.DONE.value:
                pass
            robot.retract()
    except SightlineError as error:
        return [str(error)]
    return []


TESTS: dict[str, Run] = {
    **{f"robot, app, acquisition {k + 1}": partial(tested, TIMED) for k in range(20)},
    **{f"all {k + 1}": partial(tested, ALL) for k in range(3)},
    "SIGINT ignored": partial(tested, TIMED, ignore_interrupts),
}
ROBOT: dict[str, Run] = {
    **{f"dry run {k + 1}": dry_run for k in range(500)},
    **{f"drilling {k + 1}": drilling for k in range(100)},
}


def main() -> int:
    """Run what is not finished; return 1 if any run failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=("tests", "robot"), default="tests")
    parser.add_argument("--out", type=Path, default=Path("out/busy.jsonl"), help="finished runs")
    options = parser.parse_args()
    finished, console = Finished(options.out), Console()
    plan = ROBOT if options.what == "robot" else TESTS
    with busy_cores():
        for name, run in plan.items():
            if name not in finished:
                started = time.monotonic()
                finished.add(name, failed=run(), seconds=round(time.monotonic() - started))
            made = finished[name]
            console.print(f"{name}: {made['seconds']} s", *made["failed"], sep="\n  ", soft_wrap=True)
    bad = sum(bool(finished[name]["failed"]) for name in plan)
    console.print(f"{len(plan)} runs, {bad} with a failure")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
