"""Computes curves, plan, anatomy and metrics from decisions and two calibrated views, without state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from sightline.app.plan.decisions import Decisions, Mark, Pixel
from sightline.app.plan.marks import END, ENTRY, MarkSpec, images_of, marks_of
from sightline.calibration import BeadView, CalibratedView
from sightline.case.contents import PlanRequest
from sightline.case.views import ALL_NAMES, NAMES
from sightline.errors import SightlineError
from sightline.planning import MatchingCurve, Plan, matching_curve, snap
from sightline.planning.aids import Aids
from sightline.planning.anatomy import Anatomy, locate
from sightline.planning.metrics import Metric, metrics
from sightline.planning.picks import DEFAULT_PICK_SD_PX
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.files import keeping
from sightline.planning.proposal import Proposal, propose

PICK_SD_PX = DEFAULT_PICK_SD_PX
_PICK_PX2 = PICK_SD_PX**2 * np.eye(2)


@dataclass(frozen=True, eq=False)
class Planned:
    """The results of decisions. `curves`: image-matching curves in the lateral image, by point of the wire. `refused`:
    reasons for missing results, by their names."""

    decisions: Decisions
    views: tuple[BeadView, ...]
    curves: Mapping[str, MatchingCurve] = field(default_factory=dict)
    plan: Plan | None = None
    refused: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def kind(self) -> Procedure:
        """The procedure."""
        return kind_of(self.decisions.kind)

    @cached_property
    def anatomy(self) -> Anatomy:
        """The aids located in space."""
        if self.plan is not None and self.plan.anatomy is not None:
            return self.plan.anatomy
        return locate(self.views, _aids(self.decisions))

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Metrics of the implant; none until the side is confirmed, because signs and names depend on it."""
        side = self.decisions.side
        return () if side is None else metrics(self.anatomy, side)

    def proposal(self) -> Proposal:
        """Return a wire proposed from head and shaft by the procedure's rule. Raises SightlineError."""
        side, rule = self.decisions.side, self.kind.proposal
        if side is None:
            raise _NoSideError
        assert rule is not None  # noqa: S101 - the page offers it only where there is one
        return propose(self.views, self.anatomy, side, rule=rule)


class _NoSideError(SightlineError):
    """The side of the patient is not confirmed."""

    def __init__(self) -> None:
        super().__init__("confirm the patient's side first: superior and anterior depend on it")


def planned(decisions: Decisions, views: Sequence[BeadView]) -> Planned:
    """Return the results of decisions on calibrated views: PA, lateral, and a third where there is one."""
    curves, refused = _drawn_curves(decisions, views)
    found: Plan | None = None
    if decisions.complete((ENTRY, END)) and not refused:
        try:
            found = plan_input(decisions, len(views)).plan_on(views, _curve)
        except SightlineError as error:
            refused["plan"] = str(error)
    return Planned(decisions, tuple(views), curves, found, refused)


def _drawn_curves(
    decisions: Decisions, views: Sequence[CalibratedView]
) -> tuple[dict[str, MatchingCurve], dict[str, str]]:
    """Return the curves of the wire's points in the second view, by name, and the reasons for missing ones."""
    curves: dict[str, MatchingCurve] = {}
    refused: dict[str, str] = {}
    for name in (ENTRY, END):
        at = decisions.mark(name).at(NAMES[0])
        if at is not None:
            try:
                curves[name] = _curve(views[0], np.array(at), views[1])
            except SightlineError as error:
                refused[name] = str(error)
    return curves, refused


def _curve(
    from_view: CalibratedView, uv_px: np.ndarray, to_view: CalibratedView, uv_covariance_px2: np.ndarray = _PICK_PX2
) -> MatchingCurve:
    """Return `matching_curve`, cached: moving, planning and drawing a point need the same one."""
    return _remembered(from_view, to_view, uv_px.tobytes(), uv_covariance_px2.tobytes())


@lru_cache(maxsize=8)  # the curves of two points, before and after a move, for two pages [ours]
def _remembered(from_view: CalibratedView, to_view: CalibratedView, uv_px: bytes, covariance_px2: bytes):
    covariance = np.frombuffer(covariance_px2).reshape(2, 2)
    return matching_curve(from_view, np.frombuffer(uv_px), to_view, covariance)


def landmarks_of(decisions: Decisions, views: int) -> tuple[MarkSpec, ...]:
    """Return the landmarks that a plan on this number of views uses: those placed in two of their images or more."""
    listed = (one for one in marks_of(decisions.kind) if one.group == "landmark")
    images = ALL_NAMES[:views]
    return tuple(one for one in listed if sum(decisions.mark(one.name).at(name) is not None for name in images) > 1)


def plan_input(decisions: Decisions, views: int) -> PlanRequest:
    """Return a plan's input besides its views, of this number; entry and end must be placed in PA and lateral."""
    wire = [decisions.mark(name) for name in (ENTRY, END)]
    known = kind_of(decisions.kind)
    landmarks = landmarks_of(decisions, views)
    picked = np.reshape([_pixels(decisions.mark(one.name), views) for one in landmarks], (-1, views, 2))
    return PlanRequest(
        *(_pixels(mark, views) for mark in wire),
        pick_sd_px=PICK_SD_PX,
        snapped=[not mark.free for mark in wire],
        landmarks_uv_px=picked.swapaxes(0, 1),
        landmark_names=tuple(one.of for one in landmarks),
        kind=known.key,
        procedure=keeping(known),
        side=decisions.side,
        aids=_aids(decisions),
    )


def _pixels(mark: Mark, views: int) -> np.ndarray:
    """Return the pixels (V, 2) of a mark, a row for each view, NaN where it is not placed."""
    return np.array([mark.at(name) or (np.nan, np.nan) for name in ALL_NAMES[:views]], dtype=np.float64)


def moved(
    decisions: Decisions, views: Sequence[CalibratedView], name: str, image: str, uv_px: Pixel, *, anew: bool
) -> Decisions:
    """Return the decisions with a mark placed (`anew`) or moved.

    With `decisions.snapping`, a point of the wire is snapped to its curve in the lateral image, and slides along the
    curve when its PA pixel moves. A snapped point stays snapped when it is moved, because it gives no evidence of a gap
    between the lines of sight. Raises what `snap` raises.
    """
    mark = decisions.mark(name)
    if name not in (ENTRY, END) or len(views) < 2:
        return decisions.with_mark(name, mark.placed(image, uv_px))
    if image == NAMES[1]:
        first, kept = mark.at(NAMES[0]), not anew and mark.at(image) is not None and not mark.free
        if first is None or not (decisions.snapping or kept):
            return decisions.with_mark(name, mark.placed(image, uv_px, free=True))
        curve = _curve(views[0], np.array(first), views[1])
        return decisions.with_mark(name, mark.placed(image, _pixel(snap(curve, np.array(uv_px)).uv_px), free=False))
    after = mark.placed(image, uv_px)
    if image == NAMES[0] and not mark.free and mark.complete():
        after = after.placed(NAMES[1], _slid(views, mark, uv_px))
    return decisions.with_mark(name, after)


def _slid(views: Sequence[CalibratedView], mark: Mark, uv_px: Pixel) -> Pixel | None:
    """Return a snapped point's pixel on the curve of another PA pixel: at the same depth, limited to the visible
    curve."""
    before, after = (_curve(views[0], np.array(uv), views[1]) for uv in (mark.at(NAMES[0]), uv_px))
    at = np.array(mark.at(NAMES[1]))
    nearest = int(np.argmin(np.linalg.norm(before.uv_px - at, axis=1)))
    ahead = float((at - before.uv_px[nearest]) @ before.tangent_px[nearest])
    pitch = np.gradient(before.depth_mm) / np.maximum(np.linalg.norm(np.gradient(before.uv_px, axis=0), axis=1), 1e-9)
    depth = before.depth_mm[nearest] + ahead * pitch[nearest]
    return _pixel(np.array([np.interp(depth, after.depth_mm, after.uv_px[:, k]) for k in range(2)]))


def _pixel(uv_px: np.ndarray) -> Pixel:
    return float(uv_px[0]), float(uv_px[1])


def _aids(decisions: Decisions) -> Aids:
    """Return the aids whose clicks are all placed, in all images that the procedure wants them in."""
    known = kind_of(decisions.kind)
    clicked: dict[str, list[np.ndarray | None]] = {}
    for aid in known.aids:
        images = images_of(known, aid)
        uv = [aid_pixels(decisions, aid.key, aid.clicks, image) if image in images else None for image in NAMES]
        if images and sum(one is not None for one in uv) == len(images):
            clicked[aid.key] = uv
    return Aids.clicked({aid.key: aid.type for aid in known.aids}, clicked, PICK_SD_PX)


def aid_pixels(decisions: Decisions, aid: str, clicks: int, image: str) -> np.ndarray | None:
    """Return an aid's clicks in one image, (clicks, 2); None until all are placed."""
    at = [decisions.mark(f"{aid}-{k + 1}").at(image) for k in range(clicks)]
    return None if any(uv is None for uv in at) else np.array(at, dtype=np.float64)
