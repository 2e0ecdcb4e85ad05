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
from campaigns.campaign import Finished
from sightline.errors import SightlineError
from sightline.rehearsal.operation import calibrated_robot
from sightline.robot.control.states import State
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.examination import ConformanceVerdict, Examination

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
        bad = [step for step in robot.dry_run() if step.verdict is not ConformanceVerdict.PASSED]
    return "; ".join(f"{step.name}: {step.seen}" for step in bad)


def drilling(port: int) -> str:
    """Return what went wrong, or ''."""
    with RobotClient(port=port) as robot:
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
    return ""


RUNS = {"dry run": (dry_run, 500), "drilling": (drilling, 100)}


def ended(what: str) -> str:
    """Return how a run ended: "done", "silence", or the reason."""
    try:
        with robot_in_air() as port:  # a new one, because each run leaves the arm elsewhere
            wrong = RUNS[what][0](port)
    except SightlineError as error:
        wrong = str(error)
    return "silence" if "silent for" in wrong else wrong or "done"


def main() -> int:
    """Run what is not finished; return 1 if a run ended by a false silence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry-runs", type=int, default=RUNS["dry run"][1])
    parser.add_argument("--drillings", type=int, default=RUNS["drilling"][1])
    parser.add_argument("--out", type=Path, default=Path("out/silence.jsonl"), help="finished runs")
    options = parser.parse_args()
    finished, console = Finished(options.out), Console()
    with busy_cores():
        for what, number in (("dry run", options.dry_runs), ("drilling", options.drillings)):
            for name in (f"{what} {k + 1}" for k in range(number)):
                if name not in finished:
                    finished.add(name, what=what, ended=ended(what))
    for (what, how), count in Counter((each["what"], each["ended"]) for each in finished.values()).most_common():
        console.print(f"{what}: {how}: {count}", soft_wrap=True)
    return int(any(each["ended"] == "silence" for each in finished.values()))


if __name__ == "__main__":
    sys.exit(main())
