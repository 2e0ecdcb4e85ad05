"""The simulated user of a campaign, who clicks in the images and plans; the twin's truth judges the plan."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from campaigns.campaign import Ended
from sightline.calibration import CalibratedView
from sightline.common.checks import failed
from sightline.planning import Pick, Plan, plan
from sightline.planning.bone.aids import Aids, Circle, Line
from sightline.rehearsal.patient import SHAFT_MM, RehearsedPatient
from sightline.studies.scenes import VIEWS
from sightline.twin import HipScene, SetUp

PICK_PX = 0.5  # a careful click (physics.md, Picks)
WRONG = 1.5  # times the stated 95 % bound
Shown = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Clicks:
    """The user's clicks, px.

    `wire` (2, 2, 2): view, entry or end, (u, v); `landmarks` (2, L, 2) by `names`; `head` (2, 3): circle (u, v, radius)
    in each view; `lines` (2, 5, 2): both ends of the neck's axis, then of the shaft's, and the lateral cortex, which
    only the first view has; `side`: as the user believes it to be.
    """

    wire: np.ndarray
    landmarks: np.ndarray
    names: tuple[str, ...]
    head: np.ndarray
    lines: np.ndarray
    side: str

    @staticmethod
    def on(
        setup: SetUp,
        hip: HipScene,
        rng: np.random.Generator,
        moved: Mapping[str, HipScene] | None = None,
        *,
        noise: bool = True,
    ) -> "Clicks":
        """Return clicks on the true points, with a careful click's noise. `moved`: the hip at the time of a view."""
        at = {name: (moved or {}).get(name, hip) for name in VIEWS}
        views = [setup.views[name] for name in VIEWS]
        wire = np.stack([view.project(at[view.name].wire_mm) for view in views])
        names = tuple(name.replace(" ", "-") for name in hip.landmarks_mm)  # as the kind of trajectory names them
        marks = np.stack([view.project(np.stack(list(at[view.name].landmarks_mm.values()))) for view in views])
        shown = np.all([view.in_field(marks[k], 5.0) for k, view in enumerate(views)], axis=0)
        head = np.stack([_outline(view, at[view.name]) for view in views])
        lines = np.stack([view.project(_moved(hip, at[view.name]).apply(_lines(setup, hip))) for view in views])
        kept = tuple(name for name, seen in zip(names, shown, strict=True) if seen)
        exact = Clicks(wire, marks[:, shown], kept, head, lines, setup.side)
        return exact.jittered(rng, PICK_PX if noise else 0.0)

    def jittered(self, rng: np.random.Generator, sd_px: float) -> "Clicks":
        """Return the clicks with normal noise, also on the circle's radius."""
        return replace(
            self,
            wire=self.wire + sd_px * rng.standard_normal(self.wire.shape),
            landmarks=self.landmarks + sd_px * rng.standard_normal(self.landmarks.shape),
            head=self.head + sd_px * rng.standard_normal(self.head.shape),
            lines=self.lines + sd_px * rng.spawn(1)[0].standard_normal(self.lines.shape),
        )

    def as_shown(self, shown: Mapping[str, Shown]) -> "Clicks":
        """Return the clicks at the places where damaged images show the same points."""

        def at(points: np.ndarray) -> np.ndarray:
            return np.stack([shown.get(name, lambda uv: uv)(points[k]) for k, name in enumerate(VIEWS)])

        middle = self.head[:, None, :2]
        rim = middle + self.head[:, 2, None, None] * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        radius = np.linalg.norm(at(rim) - at(middle), axis=2).mean(axis=1, keepdims=True)
        head = np.concatenate([at(middle)[:, 0], radius], axis=1)
        return replace(self, wire=at(self.wire), landmarks=at(self.landmarks), head=head, lines=at(self.lines))

    def plan(self, views: Sequence[CalibratedView], pick_sd_px: float = PICK_PX) -> Plan:
        """Return the plan from these clicks. Raises SightlineError."""
        aids = Aids(
            head=tuple(Circle.of(row[:2], float(row[2]), pick_sd_px) for row in self.head),
            neck=tuple(Line(uv[:2], pick_sd_px) for uv in self.lines),
            shaft=tuple(Line(uv[2:4], pick_sd_px) for uv in self.lines),
            cortex=Pick.free(self.lines[0, 4], pick_sd_px),
        )
        return plan(
            views,
            self.wire[:, 0],
            self.wire[:, 1],
            pick_sd_px=pick_sd_px,
            side=self.side,
            aids=aids,
            landmarks_uv_px=self.landmarks,
            landmark_names=self.names,
        )


def judged(made: Plan, wire_mm: np.ndarray) -> Ended:
    """Return how a plan compares with the true entry and end point (2, 3), CFCS."""
    bad, path = failed(made.verdict.checks), made.trajectory
    why, said = ", ".join(sorted({check.name for check in bad})), " ".join(check.sentence for check in bad)
    if not path.error_stated:
        return Ended("NO-GO", why, said=said)
    errors = np.linalg.norm(path.points.xyz_mm - wire_mm, axis=1)
    ratio = float((errors / [path.entry_error_95_mm, path.end_error_95_mm]).max())
    if made.verdict.state == "incomplete":
        return Ended("incomplete", "; ".join(made.verdict.missing), ratio, said)
    if not made.verdict.go:
        return Ended("NO-GO", why, ratio, said)
    if ratio > WRONG:
        return Ended("wrong", f"GO, off by {ratio:.1f} times its bound", ratio)
    return Ended("right", "", ratio)


def _lines(setup: SetUp, hip: HipScene) -> np.ndarray:
    """Return points (5, 3), CFCS, of a hip at rest: ends of the axes of neck and shaft, and the lateral cortex."""
    femur, patient = hip.femur, RehearsedPatient(0, setup, hip)
    ends = np.stack([femur.base_mm, np.zeros(3), *(femur.base_mm + SHAFT_MM)])
    middle = femur.base_mm + SHAFT_MM.mean(axis=0)
    return patient.in_cfcs(np.vstack([ends, femur.surface_mm(middle, np.array([1.0, 0.0, 0.0]))]))


def _moved(rest: HipScene, then: HipScene) -> RigidTransform:
    """Return the motion of a hip."""
    a, b = (np.stack([*hip.wire_mm, hip.lesser_mm, hip.greater_mm]) for hip in (rest, then))
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    return RigidTransform.from_components(b.mean(axis=0) - turn.apply(a.mean(axis=0)), turn)


def _outline(view, hip: HipScene) -> np.ndarray:
    """Return centre and mean radius (3,), px, of the head's outline in one view."""
    towards = hip.head_mm - view.focal_point_mm
    across = np.linalg.svd(towards[None])[2][1:]
    angle = np.arange(12) * np.pi / 6
    sine = hip.femur.head_radius_mm / np.linalg.norm(towards)
    rim = hip.head_mm + hip.femur.head_radius_mm / np.sqrt(1 - sine**2) * (
        np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across
    )
    uv = view.project(rim)
    centre = uv.mean(axis=0)
    return np.append(centre, np.linalg.norm(uv - centre, axis=1).mean())
