"""From picks in two or more views to a plan: trajectory, image-matching curves, verdict."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, CheckCode
from sightline.common.show import Plotted, checks_lines, dataframe
from sightline.common.threads import one_blas_thread
from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.planning.bone.aids import Aids
from sightline.planning.bone.anatomy import Anatomy, Drawings, located
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.shot import PlannedWire
from sightline.planning.nail.result import Hole, perfect_circles
from sightline.planning.points.curve import MAX_SNAP_PX, MatchingCurve, matching_curve, snap
from sightline.planning.points.lines_of_sight import refuse_repeated
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX, Pick, stack
from sightline.planning.points.reconstruct import checked_picks, points_of, refuse_exchanged
from sightline.planning.points.results import MAX_GAP_SIGMA, SpacePoints, Verdict
from sightline.planning.points.solution import Method
from sightline.planning.points.trajectory import Trajectory
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.planning.verdict.bone_checks import (
    judge_in_bone,
    left_out,
    measures,
    metric_measures,
    noticed_beyond_mm,
)
from sightline.planning.verdict.implant import Implant, fitting
from sightline.planning.verdict.plan_checks import judge
from sightline.planning.verdict.view_directions import Located, assumed_axes, rules_of_bone

if TYPE_CHECKING:
    from pandas import DataFrame

DRAWN_POINTS = 21  # [ours] along the wire, about 5 mm apart: it bends with the image's distortion

# Of two images; with a third the check "movement" says which movements it does not show.
_PAIR = (
    "No two images show a movement of the bone in the plane of both beams: take a third, oblique image, which "
    "shows it. It needs a block, since plates are seen in two views only."
)


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Plotted):
    """A trajectory, the image-matching curves of its two points in the second view, and the verdict with its checks.

    `picks`: for entry and end, the pick in each view as it was used; snapped ones lie on their curve, those of points
    that a view does not show are NaN. `seen`: entry,
    end and landmarks, in this order; `landmark_names`: names of the landmarks, "" where none was given. `anatomy`: the
    located parts of the bone. `views`: the views that the plan was made on; `arguments`: what else `plan` was given,
    but for the kind and `curve`. `relations`: checks of the relations to other wires, which the verdict then includes
    (`plan_wires`). `hole`: the measured hole that entry and end are those of.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> plan = sl.plan([pa, lateral], [[162, 689], [684, 692]], [[818, 366], [378, 276]], side="right")
    >>> round(plan.trajectory.length_mm)
    99
    >>> plan.to_dataframe().columns[0]  # needs pandas
    'name'
    """

    trajectory: Trajectory
    picks: tuple[tuple[Pick, ...], tuple[Pick, ...]]
    seen: SpacePoints
    entry_curve: MatchingCurve
    end_curve: MatchingCurve
    verdict: Verdict
    kind: Procedure
    side: str | None
    anatomy: Anatomy | None
    landmark_names: tuple[str, ...]
    views: tuple[CalibratedView, ...]
    arguments: Mapping[str, Any]
    relations: tuple[Check, ...] = ()
    hole: Hole | None = None

    def related(self, relations: tuple[Check, ...]) -> "Plan":
        """Return the plan with checks of the relations to other wires added to its verdict."""
        return replace(self, relations=relations, verdict=self.verdict.joined(Verdict(relations)))

    def summary(self) -> str:
        """Return the verdict, entry and end point with their error bounds, and the checks that failed."""
        side = "" if self.side is None else f", {self.side} side"
        first = f"Plan of a {self.kind.name}{side}: {self.verdict.state.upper()}"
        path, checks = self.trajectory.summary().splitlines()[1:], checks_lines(self.verdict.checks, 3)
        return "\n".join([first, *path, *checks, *(f"  {sentence}" for sentence in self._alone())])

    def to_dataframe(self) -> "DataFrame":
        """Return a row for each check of the verdict: name, passed, figure, limit, unit, sentence. Needs pandas."""
        rows = [vars(check) for check in self.verdict.checks]
        return dataframe({name: [row[name] for row in rows] for name in rows[0]})

    def _new_axes(self, figure: Any) -> Any:
        return figure.subplots(1, len(self.views))

    def _size_in(self) -> tuple[float, float]:
        return 6.0 * len(self.views), 6.0

    def _draw(self, ax: Any) -> None:
        """Draw each view's picks and the wire as it sees it, in the second also the curves of the first's picks."""
        from sightline.common import draw

        for k, (panel, view) in enumerate(zip(ax, self.views, strict=True)):
            picks = np.array([point[k].uv_px for point in self.picks])
            shown = picks[np.isfinite(picks[:, 0])]
            pixels, shape = getattr(view, "pixels", None), getattr(view, "image_shape", None)
            draw.image(panel, pixels, shape, shown, f"view {view.name}: {self.verdict.state.upper()}")
            if k == 1:
                for curve in (self.entry_curve, self.end_curve):
                    panel.plot(*curve.uv_px.T, color=draw.BLUE, linewidth=0.8)
                panel.plot([], [], color=draw.BLUE, label=f"lines of sight of view {self.views[0].name}")
            along = np.linspace(self.trajectory.entry_mm, self.trajectory.end_mm, DRAWN_POINTS)
            with suppress(OutsideRegionError):
                panel.plot(*view.project(along).T, color=draw.ORANGE, label="planned wire")
            draw.marks(panel, picks[:1], "o", draw.GREEN, "entry")
            draw.marks(panel, picks[1:], "s", draw.GREEN, "end")
            with suppress(OutsideRegionError):
                draw.marks(panel, view.project(self.seen.xyz_mm[2:]), "+", draw.RED, "landmarks")
            draw.legend(panel)

    @cached_property
    def noticed_mm(self) -> tuple[float | None, float | None]:
        """How far entry and end can be wrong along a line of sight before a check of the bone fails; None where no
        check would fail."""
        if not self.kind.checks or self.anatomy is None:
            return None, None
        rules = rules_of_bone(self.kind, adjusted_together(self.views))
        given = self.anatomy, rules, self.side, _landmarks_mm(self.landmark_names, self.seen)
        return noticed_beyond_mm((*measures(*given), *metric_measures(*given)), self.anatomy)

    @property
    def implant(self) -> Implant | None:
        """The implant of the procedure's catalogue that fits the wire; None where the catalogue does not tell."""
        catalogue = self.kind.document.catalogue
        length_mm = self.trajectory.length_mm
        return None if catalogue is None else fitting(catalogue, length_mm, self.anatomy, self.side)

    def sentences(self) -> list[str]:
        """Return what else a reader must know besides `unnoticed`: movements that no check shows, checks that were left
        out, other wires, and the implant that fits."""
        fits = self.implant
        bone = self.arguments["bone"]
        hidden = [_PAIR] if bone is None else [c.sentence for c in bone.checks if c.code is CheckCode.BONE_MOVEMENT]
        pair = hidden if len(self.views) == 2 else []
        axes = [assumed_axes(self.kind, self.views)]
        if self.anatomy is not None:
            rules, marks = rules_of_bone(self.kind, self.views), _landmarks_mm(self.landmark_names, self.seen)
            axes += left_out(self.anatomy, rules, self.side, marks)
            lying = Located(self.kind, self.views, self.anatomy, self.landmark_names, self.side)
            axes += [name for name in [lying.unknown_directions] if name not in self.verdict.missing]
        sentences = [*pair, *self._alone(), *([] if fits is None else [fits.sentence])]
        if self.hole is not None:
            sentences += [self.hole.sentence, *(turn.sentence for turn in perfect_circles(self.hole, self.views))]
        return [*sentences, *(sentence for sentence in axes if sentence)]

    def to_check(self, views: Sequence[CalibratedView] | None = None) -> PlannedWire:
        """Return what a check shot compares its wire with; `views`: those of the plan as they were calibrated again."""
        through = self.hole is not None
        return PlannedWire(self.trajectory, self.picks, views or self.views, self.kind.limits, through)

    @property
    def unchecked_relations(self) -> tuple[str, ...]:
        """Names of the procedure's relations between this wire and others that were not checked."""
        asked = [relation for relation in self.kind.document.relations if relation.relation != "order"]
        own = [relation.relation for relation in asked if self.kind.wire.key in relation.wires]
        checked = [check.name for check in self.relations]
        return tuple(name for name in dict.fromkeys(own) if checked.count(name) < own.count(name))

    def _alone(self) -> list[str]:
        """Return what is not checked of other wires; nothing where the relations to them are."""
        return [] if self.relations else self.kind.sentences()

    @property
    def unnoticed(self) -> str:
        """How far entry and end can be wrong along a line of sight without a failed check, as a sentence that belongs
        beside their errors; "" where a third pick or a measured hole shows it."""
        if self.hole is not None:  # a cylinder of known size, whose place along a line of sight its rims show
            return ""
        reaches = [
            f"of the {name} point {'however large' if reach is None else f'up to {reach:.1f} mm'}"
            for name, reach, picks in zip(("entry", "end"), self.noticed_mm, self.picks, strict=True)
            if np.isfinite([pick.uv_px[0] for pick in picks]).sum() == 2  # a third pick shows such an error by its gap
        ]
        return f"No check notices an error along a line of sight: {', '.join(reaches)}." if reaches else ""

    @property
    def residuals_px(self) -> np.ndarray:
        """(V, N, 2): in each view the picks of entry, end and landmarks less the projections of the points, px.

        NaN where a view does not show a point."""
        ends, landmarks = [[p.uv_px for p in point] for point in self.picks], self.arguments["landmarks_uv_px"]
        residuals = np.array(ends).swapaxes(0, 1)
        residuals = residuals if landmarks is None else np.concatenate([residuals, landmarks], axis=1)
        for k, view in enumerate(adjusted_together(self.views)):
            uv, shown = view.project_seen(self.seen.xyz_mm)
            residuals[k, shown] -= uv
            residuals[k, ~shown] = np.nan
        return residuals

    def document(self) -> dict[str, Any]:
        """Return the plan as the JSON types of `PlanDocument`."""
        hole = {}
        if self.hole is not None:
            turns = [turn.document() for turn in perfect_circles(self.hole, self.views)]
            hole = {"hole": {**self.hole.document(), "perfect_circle": turns}}
        alone = {"unchecked_relations": list(self.unchecked_relations)} if self.kind.several else {}
        return {
            **self.verdict_document(),
            "trajectory": self.trajectory.document(),
            "landmarks": self.landmarks_document(),
            "implant": None if self.implant is None else vars(self.implant),
            **hole,
            **alone,
            "checks": [vars(check) for check in self.verdict.checks],
        }

    def verdict_document(self) -> dict[str, Any]:
        """Return the verdict and its limits as JSON types, without the checks."""
        noticed = dict(zip(("entry", "end"), self.noticed_mm, strict=True))
        return {**verdict_document(self.verdict, self.kind, self.side), "noticed_along_mm": noticed}

    def landmarks_document(self) -> list[dict[str, Any]]:
        """Return the landmarks as JSON types: place (CFCS, mm), gap; `gap_sigma` is null where an error is unknown.

        With more than two views also `residual_px` by view, null where it does not show the landmark.
        """
        seen = self.seen
        sigma = None if seen.gap_sigma is None else seen.gap_sigma.tolist()
        residual_px = self.residuals_px
        return [
            {
                "name": self.landmark_names[k - len(self.picks)] or None,
                "xyz_mm": seen.xyz_mm[k].tolist(),
                "gap_mm": float(seen.gap_mm[k]),
                "gap_sigma": None if sigma is None else sigma[k],
            }
            | (_by_view(self.views, residual_px[:, k]) if len(self.views) > 2 else {})
            for k in range(len(self.picks), len(seen.xyz_mm))
        ]


def verdict_document(verdict: Verdict, kind: Procedure, side: str | None) -> dict[str, Any]:
    """Return the verdict on a wire of a procedure, and the limits, as JSON types, without the checks."""
    limits = kind.limits
    return {
        "go": verdict.go,
        "verdict": verdict.state,
        "missing": list(verdict.missing),
        "kind": kind.key,
        "procedure": {"name": kind.name, "fingerprint": kind.fingerprint},
        "side": side,
        "limits": {
            "position_mm": limits.position_mm,
            "direction_deg": float(np.rad2deg(limits.direction_rad)),
            "beyond_mm": limits.beyond_mm,
            "before_mm": limits.before_mm,
        },
    }


class SharedInputs(TypedDict, total=False):
    """Rarely given arguments of `plan`, the same for all wires of a procedure; `PlanInputs` has their defaults."""

    pick_sd_px: float
    landmarks_uv_px: ArrayLike | None
    landmark_names: Sequence[str]
    aids: Aids | None
    method: Method
    bone: RegisteredBone | None
    curve: Callable[..., MatchingCurve]


@dataclass(frozen=True, eq=False)
class PlanInputs:
    """What a plan may be given besides its views, points, procedure and side.

    `pick_sd_px`: standard deviation of a pick, per axis. `landmarks_uv_px` (V, L, 2): points of the bone picked freely
    in all views, or NaN, which show whether it moved between them; they change neither entry nor end.
    `landmark_names`: their keys in the procedure, "" for none. `aids`: what is drawn of the bone. `bone`: a CT
    or mesh that was registered in the same images (`register_bone`); its checks enter the verdict. `curve`:
    `matching_curve`, or a replacement that caches its curves.
    """

    pick_sd_px: float = DEFAULT_PICK_SD_PX
    landmarks_uv_px: ArrayLike | None = None
    landmark_names: Sequence[str] = ()
    aids: Aids | None = None
    method: Method = "weighted"
    bone: RegisteredBone | None = None
    curve: Callable[..., MatchingCurve] = matching_curve


@one_blas_thread
def plan(
    views: Sequence[CalibratedView],
    entry_uv_px: ArrayLike,
    end_uv_px: ArrayLike,
    *,
    snapped: bool | Sequence[bool] = False,
    hole: Hole | None = None,
    procedure: Procedure | str = "hip-screw",
    side: str | None = None,
    **shared: Unpack[SharedInputs],
) -> Plan:
    """Return the plan of entry and end point, given their pixels (V, 2) each, IDCS: a row for each of V >= 2 views.

    The curves lie between the first two views; give the others in the order in which their images were acquired.
    `snapped`: whether the second view's picks are snapped to the image-matching curves of the first view's: one flag,
    or (entry, end). Picks in further views are free, NaN where a view does not show the point. A plan with snapped
    picks needs two landmarks for a GO (`judge`). `hole`: entry and end are those of a measured hole
    (`WirePicks.of_hole`); its errors replace those of the picks, and its checks enter the verdict. `procedure`: a key
    of `sl.planning.procedures()`, a file, or a Procedure; sets the limits and the inputs asked for. `side` ("right",
    "left") and `aids`: the wire is checked against them where the procedure has checks of the bone; without them the
    plan is incomplete. `shared`: the fields of `PlanInputs`.
    Raises UnusableInputError, also where picks fit only with two images exchanged, and what `reconstruct`,
    `matching_curve` and `snap` raise.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> plan = sl.plan([pa, lateral], [[162, 689], [684, 692]], [[818, 366], [378, 276]], side="right")
    >>> plan.verdict.state  # without landmarks and the head drawn, some checks cannot be made
    'incomplete'
    >>> ax = plan.plot()
    """
    inputs, kind = PlanInputs(**shared), kind_of(procedure) if isinstance(procedure, str) else procedure
    each = (snapped, snapped) if isinstance(snapped, bool) else tuple(snapped)
    at_rest = _at_rest(views, inputs.bone)
    free = _landmarks(len(views), inputs)
    clicks = _Clicks(at_rest, (entry_uv_px, end_uv_px), each, free, inputs)
    (entry, entry_curve), (end, end_curve) = clicks.points()
    names = _names(kind, inputs.landmark_names, len(free))
    refuse_repeated(at_rest)
    drawings = Drawings.of(at_rest, inputs.aids or Aids(), (entry, end, *free))
    solution = drawings.solve(checked_picks(len(views), *stack([entry, end, *free])), inputs.method)
    found = clicks.not_exchanged(points_of(solution))
    seen = drawings.with_head(found) if hole is None else hole.located(found)
    asked = inputs.aids is not None or kind.checks
    anatomy = located(drawings, lambda: solution, bool(kind.document.directions)) if asked else None
    made = Plan(
        trajectory=Trajectory(seen.first(2) if free else seen),
        picks=(entry, end),
        seen=seen,
        entry_curve=entry_curve,
        end_curve=end_curve,
        verdict=Verdict(()),
        kind=kind,
        side=side,
        anatomy=anatomy,
        landmark_names=names,
        views=tuple(views),
        arguments=_arguments(entry_uv_px, end_uv_px, each, side, replace(inputs, landmark_names=names)),
        hole=hole,
    )
    return replace(made, verdict=_judged(made, at_rest))


@dataclass(frozen=True, eq=False)
class _Clicks:
    """The pixels (V, 2) of entry and end in the views, which of them are to be snapped, and the landmarks."""

    views: Sequence[CalibratedView]
    wire_uv_px: tuple[ArrayLike, ArrayLike]
    snapped: tuple[bool, ...]
    free: Sequence[tuple[Pick, ...]]
    inputs: PlanInputs

    def points(self) -> list[tuple[tuple[Pick, ...], MatchingCurve]]:
        """Return what `_picks` returns of entry and end. Raises UnusableInputError, OutsideRegionError."""
        wire = zip(self.wire_uv_px, self.snapped, strict=True)
        try:
            return [_picks(self.views, uv, self.inputs, own) for uv, own in wire]
        except (OutsideRegionError, UnusableInputError):
            self._refuse_exchanged()
            raise

    def not_exchanged(self, found: SpacePoints) -> SpacePoints:
        """Return the points. Raises UnusableInputError where their gaps tell that two images are exchanged."""
        if found.gap_failed.any():
            self._refuse_exchanged()
        return found

    def _refuse_exchanged(self) -> None:
        wire = [np.asarray(uv, dtype=np.float64) for uv in self.wire_uv_px]
        if all(uv.shape == (len(self.views), 2) for uv in wire):
            uv = np.stack([*wire, *(np.array([pick.uv_px for pick in point]) for point in self.free)], axis=1)
            as_far = MAX_SNAP_PX / MAX_GAP_SIGMA  # as a click may be from its curve
            wire_sd_px = [as_far if own else self.inputs.pick_sd_px for own in self.snapped]
            refuse_exchanged(self.views, uv, np.array([*wire_sd_px, *[self.inputs.pick_sd_px] * len(self.free)]))


def _arguments(
    entry_uv_px: ArrayLike, end_uv_px: ArrayLike, snapped: tuple[bool, ...], side: str | None, inputs: PlanInputs
) -> dict[str, Any]:
    """Return what a plan was given, but for the kind and `curve`."""
    marks = inputs.landmarks_uv_px
    return {
        "entry_uv_px": np.array(entry_uv_px, dtype=np.float64),
        "end_uv_px": np.array(end_uv_px, dtype=np.float64),
        "pick_sd_px": inputs.pick_sd_px,
        "snapped": snapped,
        "landmarks_uv_px": None if marks is None else np.array(marks, dtype=np.float64),
        "landmark_names": inputs.landmark_names,
        "side": side,
        "aids": inputs.aids,
        "method": inputs.method,
        "bone": inputs.bone,
    }


def _judged(made: Plan, views: Sequence[CalibratedView]) -> Verdict:
    """Return the verdict on a plan made on `views`, as they were adjusted together."""
    kind, names, anatomy, bone = made.kind, made.landmark_names, made.anatomy, made.arguments["bone"]
    called = {landmark.key: landmark.name for landmark in kind.landmarks}
    verdict = judge(made.trajectory, views, kind.limits, made.seen, [called.get(name, "") for name in names])
    if bone is not None:
        verdict = verdict.joined(Verdict(bone.checks_beside(verdict.checks)))
    if made.hole is not None:
        verdict = verdict.joined(Verdict(made.hole.checks))
    if kind.checks and anatomy is not None:
        rules = rules_of_bone(kind, views)
        verdict = verdict.joined(judge_in_bone(anatomy, rules, made.side, _landmarks_mm(names, made.seen)))
        verdict = verdict.joined(Located(kind, views, anatomy, names, made.side).judge())
    return verdict


def _at_rest(views: Sequence[CalibratedView], bone: RegisteredBone | None) -> Sequence[CalibratedView]:
    """Return the views adjusted together. Raises UnusableInputError for a bone that was registered to others."""
    if bone is not None:
        bone.refuse_other_views(views)
    return adjusted_together(views)


def _landmarks_mm(names: tuple[str, ...], seen: SpacePoints) -> dict[str, np.ndarray]:
    """Return the landmarks (3,) by their keys."""
    return dict(zip(names, seen.xyz_mm[2:], strict=False))


def _by_view(views: Sequence[CalibratedView], residual_px: np.ndarray) -> dict[str, Any]:
    named = zip(views, residual_px, strict=True)
    return {
        "residual_px": {view.name: None if np.isnan(residual).any() else residual.tolist() for view, residual in named}
    }


def _names(kind: Procedure, landmark_names: Sequence[str], count: int) -> tuple[str, ...]:
    """Return the landmarks' names. Raises UnusableInputError for an unknown or repeated name."""
    names = tuple("-".join(name.split()) for name in landmark_names)
    known, given = [landmark.key for landmark in kind.landmarks], [name for name in names if name]
    if not set(given) <= set(known) or len(set(given)) < len(given) or len(names) not in (0, count):
        raise UnusableInputError(
            f"{count} landmarks have the names {', '.join(map(repr, names))}; the landmarks of a {kind.name} are "
            f"{', '.join(known)}: give each name at most once, and '' to a landmark without a name"
        )
    return names or ("",) * count


def _landmarks(views: int, inputs: PlanInputs) -> list[tuple[Pick, ...]]:
    """Return free picks at (V, L, 2) pixels, in two or more views. Raises UnusableInputError."""
    if views < 2:
        raise UnusableInputError(f"{views} views given; give two or more to plan on")
    given = inputs.landmarks_uv_px
    uv = np.zeros((views, 0, 2)) if given is None else np.asarray(given, dtype=np.float64)
    if uv.ndim != 3 or uv.shape[0] != views or uv.shape[2] != 2 or (views == 2 and not np.isfinite(uv).all()):
        raise UnusableInputError(
            f"landmarks have the shape {uv.shape}; give finite pixels ({views}, L, 2): view, landmark, (u, v)"
        )
    return [tuple(Pick.free(pixel, inputs.pick_sd_px) for pixel in point) for point in np.swapaxes(uv, 0, 1)]


def _picks(
    views: Sequence[CalibratedView], uv_px: ArrayLike, inputs: PlanInputs, snapped: bool
) -> tuple[tuple[Pick, ...], MatchingCurve]:
    """Return the picks of a point in all views, and the curve of the first. Raises UnusableInputError."""
    uv, sd_px = np.asarray(uv_px, dtype=np.float64), inputs.pick_sd_px
    if uv.shape != (len(views), 2) or not np.isfinite(uv[:2]).all():
        raise UnusableInputError(
            f"give one pixel (u, v) in each of the {len(views)} images for a plan point, finite in the first two; got "
            f"the shape {uv.shape}"
        )
    first = Pick.free(uv[0], sd_px)
    curve = inputs.curve(views[0], first.uv_px, views[1], first.covariance_px2)
    second = snap(curve, uv[1], sd_px) if snapped else Pick.free(uv[1], sd_px)
    return (first, second, *(Pick.free(pixel, sd_px) for pixel in uv[2:])), curve
