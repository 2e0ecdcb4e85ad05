"""The outcome of a plan: the robot's stated errors, its drilling record, and the check shot."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from sightline.case.report.charts import WIDTH, force_trace
from sightline.common.checks import failed
from sightline.planning.check.shot import PAUSED, CheckShot, DrillShot
from sightline.robot.kinematics.target import RobotTarget
from sightline.robot.link.record import DrillingRecord

if TYPE_CHECKING:
    from sightline.common.checks import Check

BEFORE_MM = 10.0  # the plot of the force begins this far before the entry point and all events
# Error sources that a robot adds to a plan, in the order of the chain from frame to wire.
ROBOT_SOURCES = {
    "hand_eye": "where the frame sits on the flange",
    "kinematics": "where the joints' axes are, as far as imaging and drilling pose differ",
    "encoders": "resolution and play of the joints",
    "compliance": "what weight and thrust bend, which encoders cannot see",
    "drill_axis": "where the wire sits on the flange",
    "skiving": "what an oblique cortex bends the wire",
    "sleeve": "play of a wire that a person drills through a guide, and the depth as it is read",
    "depth_zero": "by how much contact with the bone shifts the zero of depth",
}


@dataclass(frozen=True, eq=False)
class Deviation:
    """True deviation of a drilled wire, from the physics of the twin: mm at entry and tip, degrees in direction."""

    against: str
    entry_mm: float
    tip_mm: float
    direction_deg: float


@dataclass(frozen=True, eq=False)
class Drilled:
    """The known parts of a drilling. `check`: the check shot, or why it was refused. `physics`: only if the truth is
    known. `by_images`: the target as images of the robot's own wire would have registered it; it was not drilled.
    `shots`: those while drilling, by the robot's state, each measured or why it was refused."""

    target: RobotTarget | None
    record: DrillingRecord | None
    check: CheckShot | str | None
    physics: tuple[Deviation, ...] = ()
    by_images: RobotTarget | None = None
    shots: Mapping[str, DrillShot | str] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the drilling as JSON types."""
        return {
            **({} if self.target is None else _sent(self.target)),
            **({} if self.by_images is None else {"by_images": {"error_95": _stated(self.by_images)}}),
            **({"shots": {state: _shown(shot) for state, shot in self.shots.items()}} if self.shots else {}),
            "record": self.record and self.record.document(),
            "check_shot": self.check and _shown(self.check),
            "physics": [vars(deviation) for deviation in self.physics],
        }


def _shown(shot: CheckShot | DrillShot | str) -> dict[str, Any]:
    return {"refused": shot} if isinstance(shot, str) else shot.document()


def _sent(target: RobotTarget) -> dict[str, Any]:
    return {
        "coordinates": "MCS",
        "plan": target.identity.plan,
        "joints": target.q.tolist(),
        "entry_mm": target.entry_mm.tolist(),
        "end_mm": target.end_mm.tolist(),
        "error_95": _stated(target),
    }


def _stated(target: RobotTarget) -> dict[str, float]:
    return {
        "entry_mm": target.entry_error_95_mm,
        "tip_mm": target.end_error_95_mm,
        "direction_deg": float(np.rad2deg(target.direction_error_95_rad)),
    }


def force_figure(record: DrillingRecord, width: float = WIDTH) -> str:
    """Return a plot of the thrust over depth near the bone, with the events; "" while there are too few samples."""
    first = min([0.0, *(event.depth_mm for event in record.events)])  # bone may begin before the entry point
    near = record.depth_mm > first - BEFORE_MM
    if np.count_nonzero(near) < 2:
        return ""
    events = {event.name: event.depth_mm for event in reversed(record.events)}  # the first of each name
    described = f"Thrust along the wire over its depth: {_noticed(record)}"
    return force_trace(record.depth_mm[near], record.force_n[near], events, described, width)


def _noticed(record: DrillingRecord) -> str:
    return ", ".join(f"{event.name} at {event.depth_mm:.1f} mm" for event in record.events)


def section(drilled: Drilled | None) -> dict[str, Any] | None:
    """Return the template context of the report's section; None without a drilling."""
    if drilled is None:
        return None
    target, check, record = drilled.target, drilled.check, drilled.record
    rows = []
    if target is not None:
        rows.append(("the robot's error, as stated before drilling (95 %)", *_figures(_stated(target))))
    if drilled.by_images is not None:
        rows.append(("the same, registered by images of its wire (95 %)", *_figures(_stated(drilled.by_images))))
    for state, shot in drilled.shots.items():
        if isinstance(shot, DrillShot):
            shown = shot.document()
            off = {**shown["deviation"], "tip_mm": shown["end_deviation_mm"]}
            rows.append((f"shot at {state}, tip {shot.depth_mm:.1f} mm deep: axis at entry and end", *_figures(off)))
            known = {**shown["error_95"], "tip_mm": shown["end_error_95_mm"]}
            rows.append((f"shot at {state}: its own error (95 %)", *_figures(known)))
    if isinstance(check, CheckShot):
        shown = check.document()
        rows.append(("check shot: the wire against the plan", *_figures(shown["deviation"])))
        rows.append(("check shot: its own error (95 %)", *_figures(shown["error_95"])))
    rows += [
        (f"physics: the wire against {deviation.against}", *_figures(vars(deviation))) for deviation in drilled.physics
    ]
    return {
        "force": Markup("" if record is None else force_figure(record)),  # noqa: S704 - made by svg.py, which escapes
        "events": "" if record is None else _noticed(record),
        "rows": rows,
        "sources": [] if target is None else _sources(target),
        "check": " ".join([*(_shot_sentence(*shot) for shot in drilled.shots.items()), check_sentence(check)]),
    }


def _shot_sentence(state: str, shot: DrillShot | str) -> str:
    if isinstance(shot, str):
        return f"The shot at {state} was refused: {shot}."
    depth = f" The tip was {shot.depth_mm:.2f} mm deep (s.d. {shot.depth_sd_mm:.2f} mm)." if state == PAUSED else ""
    return f"The shot at {state} says {shot.decision}.{depth}"


def outcome(drilled: Drilled | None) -> "tuple[str, str, str, tuple[Check, ...]] | None":
    """Return the verdict on a drilled wire: its state, word, sentence and failed checks; None while none is drilled."""
    if drilled is None or (drilled.record is None and drilled.check is None):
        return None
    if not isinstance(drilled.check, CheckShot):
        why = f"the check shot was refused: {drilled.check}" if drilled.check else "no check shot was measured"
        return "incomplete", "NOT VERIFIED", f"The wire was drilled, but {why}.", ()
    if not drilled.check.passed:
        sentence = "The check shot does not confirm the wire where it was planned."
        return "no-go", "NOT CONFIRMED", sentence, failed(drilled.check.checks)
    return "go", "CONFIRMED", "The check shot shows the wire where it was planned, within the limits.", ()


def check_sentence(check: CheckShot | str | None) -> str:
    """Return the result of the check shot as text for people."""
    if check is None:
        return "No check shot was measured."
    if isinstance(check, str):
        return f"The check shot was refused: {check}."
    return (
        f"The check shot {'passed' if check.passed else 'did NOT pass'}. It is measured against the bone, with "
        f"{check.landmarks} landmarks picked again; the wire is bent by up to {check.bow_mm:.2f} mm."
    )


def checks(drilled: Drilled | None) -> "list[tuple[str, tuple[Check, ...]]]":
    """Return titles and checks for the report's last section."""
    if drilled is None:
        return []
    of_target = () if drilled.target is None else drilled.target.checks
    of_check = drilled.check.checks if isinstance(drilled.check, CheckShot) else ()
    while_drilling = [
        (f"The shot at {state}", shot.verdict.checks)
        for state, shot in drilled.shots.items()
        if isinstance(shot, DrillShot)
    ]
    return [("The robot's target", of_target), *while_drilling, ("The check shot", of_check)]


def _figures(of: dict[str, Any]) -> tuple[str, str, str]:
    return f"{of['entry_mm']:.2f}", f"{of['tip_mm']:.2f}", f"{of['direction_deg']:.2f}"


def _sources(target: RobotTarget) -> list[tuple[str, str, str, str]]:
    """Rms error of each of the robot's own sources at entry and tip, and what it is."""
    rows = []
    for source in filter(target.budget_mm2.__contains__, ROBOT_SOURCES):
        square = target.budget_mm2[source]
        rms = (np.sqrt(np.trace(square[:3, :3])), np.sqrt(np.trace(square[3:, 3:])))
        rows.append((source.replace("_", " "), *(f"{value:.3f}" for value in rms), ROBOT_SOURCES[source]))
    return rows
