"""The drawn parts of the bone in space: a sphere for the head, axes of neck and shaft."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.geometry.covariance import block_diagonal, response
from sightline.common.geometry.lines import nearest_approach, unit
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, SightlineError, UnusableInputError
from sightline.planning.bone.aids import Aids, Line
from sightline.planning.bone.directions import caudal
from sightline.planning.bone.drawings import Axis, find_axis, find_drawing
from sightline.planning.bone.head import Redundant, Sphere, find_head, redundant_of_head
from sightline.planning.points.lines_of_sight import Drawn, Sights
from sightline.planning.points.picks import Pick, PickArrays, stack
from sightline.planning.points.results import SpacePoints
from sightline.planning.points.solution import Method, Solution, inverse, solve

_NOT_PLACED = {
    "head": "the head is not drawn: draw a circle over it in both images",
    "neck": "the neck axis is not drawn: draw a line along it in both images",
    "shaft": "the shaft axis is not drawn: draw a line along it in both images",
    "outline": "the neck's outline is not drawn: draw both borders of the neck in both images",
    "calcar": "the calcar is not clicked: click on the medial cortex of the neck in the PA image",
    "cortex": "the lateral cortex is not clicked: click on it in the PA image",
    "wire": "no wire is planned: pick entry and end point",
}


class _NotDrawnError(ReconstructionRefusedError):
    """A part is located by another one that is not drawn."""


@dataclass(frozen=True, eq=False)
class Anatomy:
    """The located parts of the bone, and `absent`: the reason for each drawn part that could not be located.

    `values` (n,), CFCS mm: the numbers of all parts; `covariance` (n, n), mm²: their joint covariance, None where a
    view's error is unknown. `at`: each part's place in `values`: "focal" (6: focal points of PA and lateral view),
    "wire" (6: entry, end), "head" (4: centre, radius), "neck", "shaft" (6: both ends), "calcar", "cortex" (3: the
    point of the click's line of sight nearest to the head and to the shaft), "outline" and the keys of other aids (see
    `find_drawing`). `waiting`: the absent parts that are located by one that is not drawn.
    """

    values: np.ndarray
    covariance: np.ndarray | None
    at: dict[str, slice]
    absent: dict[str, str]
    waiting: frozenset[str]
    head_agreement: Check | None

    def why_absent(self, name: str) -> str:
        """Return why a part is not located."""
        return self.absent.get(name) or _not_placed(name)

    def undrawn(self, name: str) -> bool:
        """Return True for a part that was not drawn, rather than refused."""
        return name not in self.at and name not in self.absent

    @cached_property
    def head(self) -> Sphere | None:
        """The femoral head, None where it is absent."""
        if "head" not in self.at:
            return None
        values = self.part("head")
        return Sphere(values[:3], float(values[3]), self._covariance_of("head"), self.head_agreement)

    @cached_property
    def neck(self) -> Axis | None:
        """Axis of the neck, None where it is absent."""
        return self._axis("neck")

    @cached_property
    def shaft(self) -> Axis | None:
        """Axis of the shaft, None where it is absent."""
        return self._axis("shaft")

    def part(self, name: str) -> np.ndarray:
        """Return the numbers of one part."""
        return self.values[self.at[name]]

    def refuse_side(self, side: str) -> None:
        """Raise ReconstructionRefusedError where the shaft lies above the head of a hip of this side."""
        if self.head is None or self.shaft is None:
            return
        if (self.shaft.ends_mm.mean(axis=0) - self.head.centre_mm) @ caudal(side) <= 0.0:
            raise ReconstructionRefusedError(
                f"the shaft lies above the head of a {side} hip; check the side, and which line is which"
            )

    def _axis(self, name: str) -> Axis | None:
        if name not in self.at:
            return None
        return Axis(self.part(name).reshape(2, 3), self._covariance_of(name))

    def _covariance_of(self, name: str) -> np.ndarray | None:
        at = self.at[name]
        return None if self.covariance is None else self.covariance[at, at]


def locate(
    views: Sequence[CalibratedView],
    aids: Aids,
    picks: Sequence[Sequence[Pick]] | None = None,
    method: Method = "weighted",
) -> Anatomy:
    """Locate what is drawn on the first two views; with `picks` (entry, end, and any landmarks) also the wire.

    `views`: PA and lateral, or two others that a procedure names, and any more in which the wire is picked.

    A part that cannot be located is listed in `absent` with the reason; the others are located all the same.
    Raises UnusableInputError.
    """
    drawn = Drawings.of(views, aids, picks)
    return located(drawn, None if picks is None else lambda: drawn.solve(stack(picks).regular(), method))


def located(drawings: "Drawings", solution: Callable[[], Solution] | None, landmarks: bool = False) -> Anatomy:
    """Return `locate` of drawings whose lines of sight are known. `solution`: returns that of their picks, if any.

    `landmarks`: the picked landmarks are a part too, "landmarks" (3 for each, in their order).

    Raises UnusableInputError.
    """
    sights, names = drawings.sights, [view.name for view in drawings.views[:2]]
    if {"pa", "lateral"} & set(names) and names != ["pa", "lateral"]:
        raise UnusableInputError("give the views 'pa' and 'lateral' first, in this order, to locate the anatomy")
    size, second = len(sights.values), 3 + 2 * len(sights.lines[0].xy_mm)
    focal = np.r_[0:3, second : second + 3]
    parts = {"focal": (sights.values[focal], np.eye(size)[focal])}
    absent, waiting, agreement = dict(drawings.absent), set[str](), None

    def part(name: str) -> np.ndarray:
        if name in absent:
            raise ReconstructionRefusedError(absent[name])
        if name not in parts:
            raise _NotDrawnError(_not_placed(name))
        return parts[name][0]

    for name, find in _finders(drawings, solution, landmarks, part).items():
        if not any(name in rows for rows in sights.rows):
            continue
        try:
            values, own, *check = find()
        except SightlineError as refusal:
            absent[name] = str(refusal)
            waiting |= {name} if isinstance(refusal, _NotDrawnError) else set()
            continue
        agreement = check[0] if check else agreement
        parts[name] = values, np.zeros((len(values), size))
        parts[name][1][:, sights.index(name)] = own
    counts = np.cumsum([0, *(len(values) for values, _ in parts.values())])
    at = {name: slice(int(a), int(b)) for name, a, b in zip(parts, counts, counts[1:], strict=False)}
    by_z, covariance = np.concatenate([own for _, own in parts.values()]), sights.covariance
    joint = None if covariance is None else by_z @ covariance @ by_z.T
    values = np.concatenate([values for values, _ in parts.values()])
    return Anatomy(values, joint, at, absent, frozenset(waiting), agreement)


def _finders(
    drawings: "Drawings", solution: Callable[[], Solution] | None, landmarks: bool, part: Callable[[str], np.ndarray]
) -> dict[str, Callable[[], tuple[Any, ...]]]:
    """Return what locates each part, by name: it returns the part's numbers (m,), their derivatives (m, n) by the
    drawing's numbers, and of the head the check that its outlines agree. `part`: returns one that is located already.
    """
    aids, sights = drawings.aids, drawings.sights
    finders: dict[str, Callable[[], tuple[Any, ...]]] = {}
    if solution is not None:
        for name in ("wire", "landmarks") if landmarks else ("wire",):
            finders[name] = lambda name=name: _picked(sights, solution(), name)
    finders |= {name: partial(find_axis, sights, name) for name in ("neck", "shaft")}
    if aids.head is not None:
        finders["head"] = partial(find_head, drawings.views[:2], aids.head)
    types = {"outline": "outline tube"} | {name: drawing.type for name, drawing in aids.others.items()}
    finders |= {name: partial(find_drawing, sights, name, kind) for name, kind in types.items()}
    finders["calcar"] = lambda: _level(sights, "calcar", part("head")[:3])
    finders["cortex"] = lambda: _level(sights, "cortex", _nearest_to_axis(sights, "cortex", part("shaft")))
    return finders


def _not_placed(name: str) -> str:
    """Return what to do for a part that is not drawn."""
    return _NOT_PLACED.get(name) or f"the {name} is not drawn: draw it as the procedure says"


def _drawn(
    views: Sequence[CalibratedView], aids: Aids, picks: Sequence[Sequence[Pick]] | None
) -> list[dict[str, Drawn]]:
    """Return the drawings of each view by name, the picks first."""
    by_view: list[dict[str, Drawn]] = [{} for _ in views]
    for k, drawn in enumerate(by_view if picks is not None else ()):
        for name, points in (("wire", (picks or ())[:2]), ("landmarks", (picks or ())[2:])):
            own = [pick[k] for pick in points if not np.isnan(pick[k].uv_px).any()]
            drawn[name] = (
                np.array([p.uv_px for p in own]).reshape(-1, 2),
                block_diagonal(np.array([p.covariance_px2 for p in own]).reshape(-1, 2, 2)),
            )
    for k, drawn in enumerate(by_view[:2]):
        if aids.head is not None:
            drawn["head"] = aids.head[k].uv_px, aids.head[k].covariance_px2
        for name in ("neck", "shaft"):
            lines = getattr(aids, name)
            if lines is not None:
                drawn[name] = _axis_in(views[k], lines[k]), lines[k].spread_px2
        if aids.outline is not None:
            variances = np.repeat([line.sd_px**2 for line in aids.outline[k]], 4)
            drawn["outline"] = np.concatenate([line.uv_px for line in aids.outline[k]]), np.diag(variances)
    for name, drawing in aids.others.items():
        for k, uv in enumerate(drawing.uv_px):
            if uv is not None and k < len(views):
                by_view[k][name] = uv, drawing.sd_px**2 * np.eye(2 * len(uv))
    for name in ("calcar", "cortex"):
        pick = getattr(aids, name)
        if pick is not None:
            by_view[0][name] = pick.uv_px[None], pick.covariance_px2
    return by_view


def _axis_in(view: CalibratedView, line: Line) -> np.ndarray:
    """Return both pixels (2, 2) of an axis: midway between its borders on the view's plane, since images are distorted.

    Outside the calibrated region, where the axis is refused, they are those of the line itself.
    """
    if line.borders_px is not None:
        with suppress(OutsideRegionError):
            lines = view.lines_of_sight(line.borders_px.reshape(4, 2))
            return view.project(lines.points_mm.reshape(2, 2, 3).mean(axis=0))
    return line.uv_px


@dataclass(frozen=True, eq=False)
class Drawings:
    """Everything drawn on views, with its lines of sight: `aids`, and the picks of a wire ("wire") and of landmarks
    ("landmarks"). `absent`: why a drawing has none, by name."""

    views: Sequence[CalibratedView]
    aids: Aids
    sights: Sights
    absent: dict[str, str]

    @staticmethod
    def of(views: Sequence[CalibratedView], aids: Aids, picks: Sequence[Sequence[Pick]] | None) -> "Drawings":
        """Return the drawings; `picks`: entry, end, then landmarks. Raises ReconstructionRefusedError."""
        absent: dict[str, str] = {}
        return Drawings(views, aids, _sights(views, _drawn(views, aids, picks), absent), absent)

    def solve(self, picks: PickArrays, method: Method) -> Solution:
        """Return the solution of the picks. Raises OutsideRegionError, ReconstructionRefusedError."""
        for name in ("wire", "landmarks"):
            if name in self.absent:
                raise OutsideRegionError(self.absent[name])
        counts = picks.seen.sum(axis=1)
        lines = [sight.first(int(count)) for sight, count in zip(self.sights.lines, counts, strict=True)]
        return solve(lines, picks, method)

    def with_head(self, seen: SpacePoints) -> SpacePoints:
        """Return the points of `solve` with shift and chi-square by all that two images show of the bone's movement:
        their gaps and that of the head, which share the errors of the views."""
        covariance, circles = self.sights.covariance, self.aids.head
        if len(self.views) > 2 or seen.shift_mm is None or "head" in self.absent:
            return seen
        if circles is None or covariance is None:
            return seen
        try:
            rims = redundant_of_head(self.views, circles)
        except ReconstructionRefusedError:  # the reason is in `Anatomy.absent`
            return seen
        names = [name for name in ("wire", "landmarks") if name in self.sights.rows[0]]
        parts = {name: self._gaps(name) for name in names}
        normals = np.concatenate([part.by_shift for part in parts.values()])
        own = covariance[np.ix_(self.sights.index("head"), self.sights.index("head"))]
        parts["head"] = rims.along(unit(normals[seen.gap_tested].mean(axis=0)), own)
        kept = np.append(seen.gap_tested, True)
        values = np.concatenate([part.values for part in parts.values()])[kept]
        by_z, first = np.zeros((len(kept), len(covariance))), 0
        for name, part in parts.items():
            by_z[first : first + len(part.values), self.sights.index(name)] = part.by_z
            first += len(part.values)
        information = inverse((by_z @ covariance @ by_z.T)[np.ix_(kept, kept)])
        weights = information.sum(axis=0)
        return replace(
            seen,
            shift_mm=float(weights @ values / weights.sum()),
            shift_sd_mm=float(1.0 / np.sqrt(weights.sum())),
            gap_chi2=float(values @ information @ values),
            head_tested=True,
        )

    def _gaps(self, name: str) -> Redundant:
        """Return the signed gaps of picks, which are the shift of the bone along the common normals of their lines."""

        def apart(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            (focal, a), (other, b) = self.sights.rays(name, z)
            return unit(np.cross(a - focal, b - other)), other - focal

        at = self.sights.values[self.sights.index(name)]
        values, by_z = response(lambda z: np.multiply(*apart(z)).sum(axis=-1), at)
        return Redundant(values, by_z, apart(at[None])[0][0])


def _sights(views: Sequence[CalibratedView], drawn: list[dict[str, Drawn]], absent: dict[str, str]) -> Sights:
    """Return the lines of sight of all drawings. A drawing outside a view's calibrated region goes into `absent`."""
    try:
        return Sights.of(views, drawn)
    except OutsideRegionError:
        for view, named in zip(views, drawn, strict=True):
            for name, (uv, _) in list(named.items()):
                try:
                    view.lines_of_sight(uv)
                except OutsideRegionError as refusal:
                    absent[name] = str(refusal)
        return Sights.of(views, [{n: d for n, d in named.items() if n not in absent} for named in drawn])


# Points of a solution: entry and end, then the landmarks.
_POINTS = {"wire": slice(0, 2), "landmarks": slice(2, None)}


def _picked(sights: Sights, solution: Solution, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (3n,) of the picks' solution that are drawn as `name`, and their derivatives by the drawing's
    numbers."""
    points = np.arange(len(solution.xyz_mm))[_POINTS[name]]
    rows = (3 * points[:, None] + np.arange(3)).ravel()
    own = [
        np.hstack([by_line[rows, :3], by_line[rows, 3 + 2 * at[name].start : 3 + 2 * at[name].stop]])
        for by_line, at in zip(solution.response, sights.rows, strict=True)
    ]
    return solution.xyz_mm[points].ravel(), np.hstack(own)


def _nearest_to_axis(sights: Sights, name: str, ends: np.ndarray) -> np.ndarray:
    """Return the point (3,) of a single click's line of sight nearest to an axis (6,: both ends)."""
    ((focal, points),) = sights.rays(name, sights.values[sights.index(name)][None])
    along = (ends[3:] - ends[:3])[None]
    return nearest_approach(focal[0], (points - focal)[0], ends[None, :3], along).first_mm[0]


def _level(sights: Sights, name: str, with_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point (3,) of a single click's line of sight at the depth of `with_mm` (3,), its derivatives (3, n).

    The click measures nothing along its line of sight, so the error of `with_mm` does not matter.
    """
    at = sights.values[sights.index(name)]

    def pierced(z: np.ndarray) -> np.ndarray:
        ((focal, points),) = sights.rays(name, z)
        ray, normal = (points - focal)[:, 0], with_mm - focal[:1, 0]
        return (
            focal[:, 0]
            + ((with_mm - focal[:, 0]) * normal).sum(-1, keepdims=True) / (ray * normal).sum(-1, keepdims=True) * ray
        )

    return response(pierced, at)
