"""Dry runs and drillings with all cores busy: `python -m campaigns.silence`. None may end because of a silent client.

Each dry run is that of `sightline robot check`, which also requires that real silence stops the wire; each drilling
goes through air to the tip. The robot is a separate process. Finished runs are kept; the same command resumes a stopped
run.
"""

import argparse
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from scipy.spatial.transform import RigidTransform

from campaigns.busy import busy_cores
from sightline.errors import SightlineError
from sightline.rehearsal.operation import calibrated_robot
from sightline.robot.control.states import State
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.examination import ConformanceVerdict, Examination

DRY_RUNS, DRILLINGS = 500, 100
AHEAD_MM = 125.0  # to the end of a bare target, whose wire is 95 mm: its entry is 30 mm ahead


@contextmanager
def robot_in_air() -> Iterator[int]:
    """Yield the port of a simulated robot in a separate process."""
    command = [sys.executable, "-m", "sightline", "robot", "serve", "--attached", "--port", "0", "--quiet"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        yield json.loads(process.stdout.readline())["port"]
        process.stdin.close()


def dry_run(port: int) -> str:
    """Return what went wrong, or ''."""
    with Examination("127.0.0.1", port) as robot:
        bad = [f"{one.name}: {one.seen}" for one in robot.dry_run() if one.verdict is not ConformanceVerdict.PASSED]
    return "; ".join(bad)


def drilling(port: int) -> str:
    """Return what went wrong, or ''."""
    with RobotClient(port=port) as robot:
        robot.start_up()
        q = robot.joints()[0]
        manipulator = calibrated_robot().manipulator
        registration = manipulator.T_mcs_cfcs(q)
        robot.calibrate(registration)
        wire = registration.inv() * manipulator.T_mcs_tool(q)
        robot.aim(wire * RigidTransform.from_translation([0.0, 2.0, AHEAD_MM]))
        robot.align()
        while robot.drill() != State.DONE.value:
            pass
        robot.retract()
    return ""


def ended(what: str, port: int) -> str:
    """Return how a run ended: "done", "silence", or the reason."""
    try:
        wrong = dry_run(port) if what == "dry run" else drilling(port)
    except SightlineError as error:
        wrong = str(error)
    return "silence" if "silent for" in wrong else wrong or "done"


def main() -> int:
    """Run what is not finished; return 1 if a run ended by a false silence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry-runs", type=int, default=DRY_RUNS)
    parser.add_argument("--drillings", type=int, default=DRILLINGS)
    parser.add_argument("--out", type=Path, default=Path("out/silence.jsonl"), help="finished runs")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    told = [json.loads(line) for line in lines]
    asked = {"dry run": options.dry_runs, "drilling": options.drillings}
    with busy_cores():
        for what, number in asked.items():
            for _ in range(number - sum(one["what"] == what for one in told)):
                with robot_in_air() as port:  # a new one, because each run leaves the arm elsewhere
                    told.append({"what": what, "ended": ended(what, port)})
                with options.out.open("a") as out:
                    out.write(json.dumps(told[-1]) + "\n")
    console = Console()
    for what in asked:
        for how, count in Counter(one["ended"] for one in told if one["what"] == what).most_common():
            console.print(f"{what}: {how}: {count}", soft_wrap=True)
    return int(any(one["ended"] == "silence" for one in told))


if __name__ == "__main__":
    sys.exit(main())
