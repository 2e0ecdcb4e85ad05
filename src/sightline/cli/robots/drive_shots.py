"""Shots while `robot drive` waits: two images against the plan that a case holds, and GO, STOP or INCOMPLETE."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from sightline.checks import failed
from sightline.cli.planning.check_shot import landmarks_of
from sightline.cli.planning.plan import images_of
from sightline.cli.planning.points import parse_found_again, parse_wire_points

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import CheckRequest, DrillShotRequest
    from sightline.case.interop.plan_file import PlanFile
    from sightline.case.journal import Case, Entry
    from sightline.case.replay import Recomputed
    from sightline.cli.output import Output
    from sightline.frame import Frame
    from sightline.planning.check.drill_shot import DrillShot
    from sightline.robot.kinematics.target import RobotTarget
    from sightline.robot.link.client import RobotClient

FROM_CASE = "case"  # instead of files


def planned_in(folder: Path, plan: "PlanFile") -> int:
    """Return the number of a plan's entry in the case of a folder. Raises CaseError, RobotRefusedError."""
    from sightline.case.journal import Case, Kind
    from sightline.errors import RobotRefusedError

    points = plan.points_mm.tolist()
    with Case.open(folder, read_only=True) as case:
        for entry in reversed(case.entries(Kind.PLANNED)):
            path = entry.content["trajectory"]
            if entry.content.get("kind") == plan.document.kind and [path["entry_mm"], path["end_mm"]] == points:
                return entry.number
    raise RobotRefusedError(
        "the case does not hold this plan, so that no shot can be compared with it; plan with --case and --out together"
    )


@dataclass(frozen=True, eq=False)
class DriveShots:
    """The shots of one drilling, against the plan of the entry `planned` in the case of `folder`.

    `pick_sd_px`: standard deviation of a pick. `on_patient`: the frame fixed to the patient; None for the plan's own
    block, put back on its mount. `taken`: the results by the robot's state.
    """

    output: "Output"
    folder: Path
    planned: int
    robot: "RobotClient"
    target: "RobotTarget"
    pick_sd_px: float
    on_patient: "Frame | None" = None
    taken: "dict[str, DrillShot]" = field(default_factory=dict)

    def ask(self, state: str) -> None:
        """Measure the shot that a person gives while the robot waits in a state, until it says GO or none is given.

        A depth that says GO in PAUSED is sent to the robot. Raises RobotRefusedError for a shot that says STOP.
        """
        from sightline.errors import RobotRefusedError, SightlineError
        from sightline.planning.check.drill_shot import PAUSED

        with_it = "put the block on its mount" if self.on_patient is None else "leave the frame on the patient"
        while True:
            given = typer.prompt(
                f"Shot at {state}: {with_it}, take two images, and give both files 'PA LATERAL', or '{FROM_CASE}' for "
                "the newest of the case; with nothing you decide by eye",
                default="",
                show_default=False,
                err=True,
            )
            if not given.strip():
                _answer(f"{state}: no shot was given; the decision is yours")
                return
            try:
                found = self._measure(state, shlex.split(given))
            except SightlineError as refused:
                _answer(f"{state}: not measured: {refused}")
                continue
            self.taken[state] = found
            _say(self.output, found)
            if found.decision == "STOP":
                raise RobotRefusedError(f"the shot at {state} says STOP: {_reasons(found)}")
            if found.decision == "GO":
                if state == PAUSED:
                    self.robot.shot_depth(found.depth_mm, found.depth_sd_mm)
                    _answer("the depth was sent to the robot")
                return

    def document(self) -> dict[str, Any]:
        """Return the shots as JSON types, by state."""
        return {state: found.document() for state, found in self.taken.items()}

    def _measure(self, state: str, files: list[str]) -> "DrillShot":
        """Read, calibrate and measure two images, and record them with the result. Raises SightlineError."""
        from sightline.case.journal import Actor, Case
        from sightline.case.pairs import record_images
        from sightline.case.replay import Recomputed
        from sightline.case.stages import frame_of, record_shot
        from sightline.case.views import calibrate_pair
        from sightline.errors import RefusedError, UnusableInputError

        if files != [FROM_CASE] and len(files) != 2:
            raise UnusableInputError(f"give the files of two images, PA first, or '{FROM_CASE}'; got {len(files)}")
        paths = None if files == [FROM_CASE] else tuple(map(Path, files))
        with Case.open(self.folder) as case:
            plan, again = case.entry(self.planned), Recomputed(case)
            frame = self.on_patient or frame_of(case, case.entry(plan.rests_on[0]).settings["frame"])
            asked = self._asked(state, again, plan)
            with self.output.step("finding and labelling the beads"):
                seen = images_of(self.output, case, paths, frame, invert=False, after=self._newest(case))
            before = again.images(plan)[:2]
            arm = before[0].view.c_arm
            known = {} if arm is None else {"source_detector_mm": arm.source_detector_mm, "pixel_mm": arm.pixel_mm}
            mirrored = [one.name for one in before if one.view.mirrored_display]
            with self.output.step("calibrating both views"):
                images = calibrate_pair(seen.seen, frame, "smooth", mirrored, **known)
            views = record_images(case, seen, images, frame, by=Actor.COMMAND)
            try:
                with self.output.step("measuring the wire"):
                    found = asked.shot(again.plan(plan), again.images(plan), images, again.others_mm(plan))
            except RefusedError as refused:
                record_shot(case, plan, views, asked, str(refused), by=Actor.COMMAND)
                raise
            record_shot(case, plan, views, asked, found, by=Actor.COMMAND)
        return found

    def _newest(self, case: "Case") -> int:
        """Return the number of the last entry that is older than the images of this moment."""
        from sightline.case.journal import Kind

        return max([self.planned, *(entry.number for entry in case.entries(Kind.SHOT, self.planned))])

    def _asked(self, state: str, again: "Recomputed", plan: "Entry") -> "DrillShotRequest":
        """Return the request with what a person picks, and with what the robot's encoders say."""
        from sightline.case.contents import DrillShotRequest
        from sightline.planning.check.drill_shot import ALIGNED
        from sightline.robot.kinematics.manipulator import FEED

        stood, straight = self.target.registration, state == ALIGNED
        check, picked = self._picks(again, plan, straight=straight)
        q = self.robot.joints()[0]
        tip_mm = float(q[FEED] - self.target.q[FEED])
        if self.on_patient is not None:
            return DrillShotRequest(check, tip_mm, straight, None, None, picked)
        middle_mm = again.plan(plan).trajectory.points.xyz_mm.mean(axis=0)
        movement, covariance = stood.robot.frame_moved(stood.q, q, middle_mm)
        return DrillShotRequest(check, tip_mm, straight, movement.as_matrix(), covariance, picked)

    def _picks(self, again: "Recomputed", plan: "Entry", *, straight: bool) -> "tuple[CheckRequest, np.ndarray | None]":
        """Return the landmarks, and the points on the wire (2, M, 2) or None, that a person picks in both images."""
        from sightline.case.contents import CheckRequest
        from sightline.errors import UnusableInputError

        asked, points = plan.content["asked"], []
        while text := _line("A landmark found again, 'NAME check-pa:U,V check-lateral:U,V'; nothing ends"):
            points.append(parse_found_again(text))
        where = "on the wire in its guide" if straight else "on the wire, if it is not to be found by itself"
        text = _line(f"Points {where}, the tip last: 'check-pa:U,V,U,V,... check-lateral:U,V,U,V,...'")
        if straight and not text:
            raise UnusableInputError("in its guide the wire is not found by itself: give points on it in both images")
        landmarks = landmarks_of(points, asked["landmark_names"], asked["landmarks_uv_px"], self.pick_sd_px)
        check = CheckRequest(again.plan(plan).kind.wire_mm, landmarks)
        return check, parse_wire_points(text) if text else None


def _line(question: str) -> str:
    return str(typer.prompt(question, default="", show_default=False, err=True)).strip()


def _answer(text: str) -> None:
    """Print what a person needs to go on, also with --json."""
    typer.echo(text, err=True)


def _reasons(found: "DrillShot") -> str:
    return " ".join(one.sentence for one in failed(found.verdict.checks))


def _say(output: "Output", found: "DrillShot") -> None:
    """Print a shot for people: its decision, what failed, and what was measured."""
    shown = found.document()
    off, error = shown["deviation"], shown["error_95"]
    _answer(f"{found.state}: {found.decision}{'' if found.decision == 'GO' else f': {_reasons(found)}'}")
    rows = [
        ("axis at the entry", f"{off['entry_mm']:.2f} mm", f"{error['entry_mm']:.2f} mm"),
        (
            "axis at the end, drilled on straight",
            f"{shown['end_deviation_mm']:.2f} mm",
            f"{shown['end_error_95_mm']:.2f} mm",
        ),
        ("direction", f"{off['direction_deg']:.2f}°", f"{error['direction_deg']:.2f}°"),
    ]
    output.table("Wire against the plan", ("of", "deviation", "95 % error"), rows)
    output.say(f"the tip is {found.depth_mm:.2f} mm beyond the planned entry (s.d. {found.depth_sd_mm:.2f} mm)")
