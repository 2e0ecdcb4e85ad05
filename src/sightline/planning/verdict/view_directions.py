"""The directions from which the images of a plan were taken, and its side, against what its procedure wants.

The patient's axes are those of a frame with plates, or those that the bone shows. A procedure's file states directions
of the bone (`BoneDirection`). The first two, as located in space, tell how the patient lies; the third tells the side,
since a left bone is the mirror image of a right one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.geometry.covariance import TWO_SIDED_95, response
from sightline.common.geometry.lines import across, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.directions import ANTERIOR, MEDIAL, anatomical, caudal, lies
from sightline.planning.bone.drawings import line_of_tube
from sightline.planning.points.lines_of_sight import no_lines
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.document import (
    HEAD_CENTRE,
    AidType,
    BoneDirection,
    CheckRule,
    ProcedureDocument,
    WantedView,
)

# Middle and axis (K, 3) of a part, of K sets of its numbers and its name.
_Of = Callable[[np.ndarray, str], np.ndarray]
_MIDDLES: Mapping[AidType, _Of] = {
    "point": lambda part, name: part[:, :3],
    "sphere": lambda part, name: part[:, :3],
    "line": lambda part, name: (part[:, :3] + part[:, 3:]) / 2,
    "plane": lambda part, name: part[:, :3],
    "cylinder": lambda part, name: part[:, :3],
    "rim pair": lambda part, name: (part[:, :3] + part[:, 3:]) / 2,
    "outline tube": lambda part, name: line_of_tube(part.reshape(-1, 2, 5, 3), name)[0],
}
_AXES: Mapping[AidType, _Of] = {
    "line": lambda part, name: part[:, 3:] - part[:, :3],
    "plane": lambda part, name: part[:, 3:],
    "cylinder": lambda part, name: part[:, 3:6],
    "rim pair": lambda part, name: part[:, 3:] - part[:, :3],
    "outline tube": lambda part, name: line_of_tube(part.reshape(-1, 2, 5, 3), name)[1],
}
_NAME = "view directions"
# Along lateral, caudal, anterior.
_WAYS = (("lateral of", "medial of"), ("caudal of", "cranial of"), ("in front of", "behind"))
# Checks along lateral, caudal or anterior: those of the frame, by the stated side.
_ALONG_AXES = ("side", "lateral of lesser trochanter", "anterior of lesser trochanter")
_ASSUMED = (
    "The block's axes are taken for the patient's: x towards the operated side, z forwards. No image confirms this, so "
    "the checks of the side and of the lesser trochanter hold only if the block was placed like this."
)


@dataclass(frozen=True, eq=False)
class BoneAxes:
    """Directions of the bone as far as they are located: `document` names them.

    `landmarks`: the keys of the picked landmarks, in the order of the part "landmarks".
    """

    anatomy: Anatomy
    document: ProcedureDocument
    landmarks: Sequence[str]
    side: str

    def lacking(self, directions: Sequence[BoneDirection]) -> list[str]:
        """Return what is missing of some directions, each as a clause that says what to do."""
        names = {landmark.key: landmark.name for landmark in self.document.landmarks}
        clauses = []
        for key in dict.fromkeys(key for way in directions for key in (*way.from_, *way.to, way.along) if key):
            if key in names and key not in self.landmarks:
                clauses.append(f"the landmark '{names[key]}' is not picked: pick it in both images and name it")
            elif key not in (*names, "entry", "end") and key not in self.anatomy.at:
                clauses.append(self.anatomy.why_absent(key))
        return clauses

    def axes(self, values: np.ndarray) -> np.ndarray:
        """Return lateral, caudal and anterior (K, 3, 3) as rows, CFCS, of K sets of `Anatomy.values`."""
        measured = self._triad(*(self._vector(direction, values) for direction in self.document.directions[:2]))
        nominal = self._triad(*(direction.nominal[None] for direction in self.document.directions[:2]))
        # A left bone is mirrored: the third axis of its nominal triad points the other way.
        nominal = nominal * [[1.0], [1.0], [1.0 if self.side == "right" else -1.0]]
        return np.swapaxes(nominal, 1, 2) @ measured

    def scatter_rad2(self) -> np.ndarray:
        """Return the covariance (3, 3) of a small rotation of the axes: by how much bones differ from the nominal."""
        first, second = (direction.nominal for direction in self.document.directions[:2])
        a, b = np.deg2rad([direction.sd_deg for direction in self.document.directions[:2]])
        about = np.outer(first, first)
        return a**2 * (np.eye(3) - about) + b**2 / float(np.sum(across(second, first) ** 2)) * about

    def beside(self) -> tuple[float, float]:
        """Return how far the third direction points to where it points in a patient of the stated side, mm, and the
        standard deviation of that."""
        first, second, third = self.document.directions
        way = np.sign(np.cross(first.nominal, second.nominal) @ third.nominal) * (1 if self.side == "right" else -1)

        def value(values: np.ndarray) -> np.ndarray:
            a, b, c = (self._vector(direction, values) for direction in (first, second, third))
            return way * (unit(np.cross(a, b)) * c).sum(axis=-1, keepdims=True)

        (at,), (own,) = response(value, self.anatomy.values)
        length = float(np.linalg.norm(self._vector(third, self.anatomy.values[None])))
        scatter = length**2 * float(np.linalg.eigvalsh(self.scatter_rad2())[-1])
        return float(at), float(np.sqrt(own @ self.anatomy.covariance @ own + scatter))

    @staticmethod
    def _triad(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        along = unit(first)
        beside = unit(across(second, along))
        return np.stack([along, beside, np.cross(along, beside)], axis=1)

    def _vector(self, asked: BoneDirection, values: np.ndarray) -> np.ndarray:
        """Return a direction (K, 3), mm."""
        start, stop = (np.mean([self._point(key, values) for key in keys], axis=0) for keys in (asked.from_, asked.to))
        if asked.along is None:
            return stop - start
        axis = _AXES[self._type(asked.along)](values[:, self.anatomy.at[asked.along]], asked.along)
        return axis * np.sign(axis[0] @ (stop - start)[0])

    def _point(self, key: str, values: np.ndarray) -> np.ndarray:
        if key in ("entry", "end"):
            return values[:, self.anatomy.at["wire"]][:, slice(0, 3) if key == "entry" else slice(3, 6)]
        if key in self.landmarks:
            first = self.anatomy.at["landmarks"].start + 3 * list(self.landmarks).index(key)
            return values[:, first : first + 3]
        return _MIDDLES[self._type(key)](values[:, self.anatomy.at[key]], key)

    def _type(self, key: str) -> AidType:
        return next(aid.type for aid in self.document.aids if aid.key == key)


def frame_axes(side: str | None) -> np.ndarray:
    """Return lateral, caudal and anterior (3, 3) as rows, CFCS of a frame with plates; without a side of a right one.

    Raises UnusableInputError.
    """
    return np.stack([-MEDIAL, caudal(side or "right"), ANTERIOR])


@dataclass(frozen=True, eq=False)
class Located:
    """What a plan knows of how the patient lies: its `views` as they were taken, the `anatomy` with the picked
    landmarks, their keys ("" for none), and the stated `side`."""

    procedure: Procedure
    views: Sequence[CalibratedView]
    anatomy: Anatomy
    landmarks: Sequence[str]
    side: str | None

    def judge(self) -> Verdict:
        """Return the checks of the views' directions and of the bone's side, as far as the procedure asks for them."""
        return self._directions().joined(self._side())

    @property
    def unknown_directions(self) -> str:
        """Why the procedure's check of directions cannot be made, or ""."""
        if all(rule.check != _NAME for rule in self.procedure.checks):
            return ""
        if self.side is None and any(view.tilt_deg for view in self.procedure.document.views):
            return "The directions of the images are not checked: the side is not given, which tells head from feet."
        if _axes_of_frame(self.views):
            return ""
        unsaid = "The directions of the images are not checked: nothing says how the patient lies to this frame"
        directions = self.procedure.document.directions
        if not directions:
            return (
                f"{unsaid}, and the procedure's file states no directions of the bone. Compare both images with the "
                "views that `sightline procedure show` names."
            )
        lacking = self._lacking(directions[:2])
        return f"{unsaid}; {lacking}." if lacking else ""

    @property
    def _bone(self) -> BoneAxes:
        return BoneAxes(self.anatomy, self.procedure.document, self.landmarks, self.side or "right")

    def beside(self) -> tuple[float, float]:
        """Return how far the third direction of the bone points as on the stated side, mm, and its 95 % error."""
        value, sd = self._bone.beside()
        return value, TWO_SIDED_95 * sd

    @property
    def unknown_side(self) -> str:
        """Why the bone's directions do not show the side, or ""."""
        lacking = self._lacking(self.procedure.document.directions)
        return f"The bone does not confirm the side: {lacking}." if lacking else ""

    def _lacking(self, directions: Sequence[BoneDirection]) -> str:
        """Return what is missing for some directions of the bone, as text."""
        lacking = self._bone.lacking(directions)
        lacking += ["the side is not given"] if self.side is None else []
        lacking += ["the error of a view is not stated"] if self.anatomy.covariance is None else []
        return "; ".join(lacking)

    def _directions(self) -> Verdict:
        rule = next((asked for asked in self.procedure.checks if asked.check == _NAME), None)
        if rule is None:
            return Verdict(())
        return _known(
            _NAME, "°", self.unknown_directions, lambda: self.worst_view().check(), required=rule.optional is None
        )

    def worst_view(self) -> "JudgedView":
        """Return the view that is farthest beyond its tolerance, with its error. Raises ReconstructionRefusedError."""
        wanted = self.procedure.document.views
        names = [view.name for view in self.views[2:]]
        asked = [view for k, view in enumerate(wanted) if k < 2 or view.name in names]
        beams, errors = self.beams([0, 1, *(2 + names.index(view.name) for view in asked[2:])])
        judged = [JudgedView.of(*each) for each in zip(asked, beams, errors, strict=False)]
        return max(judged, key=lambda view: view.over_deg)

    def beams(self, of: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the beams (V, 3) at the wire's middle of some views, anatomical, and their 95 % errors (V,), rad.

        An error is that of the direction in which it is largest.
        """
        anatomy, at = self.anatomy, self.anatomy.at
        further = [self.views[k].focal_point_mm for k in of[2:]]

        def beams(values: np.ndarray) -> np.ndarray:
            middle = values[:, at["wire"]].reshape(-1, 2, 3).mean(axis=1)
            focal = [values[:, at["focal"]][:, :3], values[:, at["focal"]][:, 3:], *further]
            return unit(np.stack([middle - source for source in focal], axis=1))

        if _axes_of_frame(self.views):
            return beams(anatomy.values[None])[0] @ frame_axes(self.side).T, np.zeros(len(of))
        bone = self._bone
        assert anatomy.covariance is not None  # noqa: S101 - else `unknown_directions`
        flat, own = response(
            lambda values: (beams(values) @ np.swapaxes(bone.axes(values), 1, 2)).reshape(len(values), -1),
            anatomy.values,
        )
        judged, by_values = flat.reshape(-1, 3), own.reshape(len(of), 3, -1)
        turned = np.cross(judged[:, None], np.eye(3))  # of a beam, by a small rotation about each axis
        scatter = np.swapaxes(turned, 1, 2) @ bone.scatter_rad2() @ turned
        measured = by_values @ anatomy.covariance @ np.swapaxes(by_values, 1, 2)
        return judged, TWO_SIDED_95 * np.sqrt(np.linalg.eigvalsh(measured + scatter)[:, -1])

    def _side(self) -> Verdict:
        """Return the check that the bone is one of the stated side, where its directions show that."""
        document = self.procedure.document
        rule = next((rule for rule in self.procedure.checks if rule.check == "side"), None)
        stated_before = self.side is None and rule in rules_of_bone(self.procedure, self.views)
        if rule is None or len(document.directions) < 3 or stated_before:
            return Verdict(())
        by_frame = _side_by_frame(document, self.views)
        return _known(
            "side", "mm", self.unknown_side, self._side_check, required=rule.optional is None and not by_frame
        )

    def _side_check(self) -> Check:
        """Return the check that the third direction of the bone points as on the stated side."""
        value, error = self.beside()
        third = self.procedure.document.directions[2]
        to, start = (" and ".join(keys).replace("-", " ") for keys in (third.to, third.from_))
        axis = int(np.argmax(np.abs(third.nominal)))
        positive, negative = _WAYS[axis]
        ways = (positive, negative) if third.nominal[axis] > 0.0 else (negative, positive)
        sentence = (
            f"For a {self.side} side the {to} must lie {ways[0]} the {start}: it lies {lies(value, ways)} it, with "
            f"95 % probability within {error:.1f} mm"
        )
        if value <= error:
            sentence += (
                f"; this is not a {self.side} side, an image is mirrored, or points are exchanged: look at both "
                "images, then give the other side or pick again"
            )
        return Check("side", value > error, value, error, "mm", f"{sentence}.")


def _known(name: str, unit: str, unknown: str, make: Callable[[], Check], *, required: bool) -> Verdict:
    """Return the check that `make` makes. Where it is `unknown` for a reason, it is missing if it is required; where
    `make` raises ReconstructionRefusedError, it fails."""
    if unknown:
        return Verdict((Check(name, False, None, None, unit, unknown, missing=True),) if required else ())
    try:
        return Verdict((make(),))
    except ReconstructionRefusedError as refusal:
        return Verdict((Check(name, False, None, None, unit, f"Not known: {refusal}."),))


@dataclass(frozen=True, eq=False)
class JudgedView:
    """A view's `beam` (3,), anatomical, against the wanted one: `away_deg` from it, with its 95 % error."""

    wanted: WantedView
    beam: np.ndarray
    away_deg: float
    error_deg: float

    @staticmethod
    def of(wanted: WantedView, beam: np.ndarray, error_rad: float) -> "JudgedView":
        """Return the view of a beam with its 95 % error, rad."""
        cosine = beam @ anatomical(wanted.orbit_deg, wanted.tilt_deg)
        away = float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
        return JudgedView(wanted, beam, away, float(np.rad2deg(error_rad)))

    @property
    def over_deg(self) -> float:
        """How far the view is beyond its tolerance, with its error; negative within."""
        return self.away_deg + self.error_deg - self.wanted.within_deg

    def check(self) -> Check:
        """Return the check that the whole 95 % interval lies within the tolerance."""
        wanted = self.wanted
        known = f", with 95 % probability within {self.error_deg:.0f}°" if self.error_deg else ""
        sentence = (
            f"The view {wanted.name} is {self.away_deg:.0f}° from its wanted direction{known} (at most "
            f"{wanted.within_deg:.0f}°{', with its error' if known else ''})"
        )
        if self.over_deg > 0.0:
            orbit, tilt = angles_of(self.beam)
            sentence += (
                f"; its beam is at orbit {orbit:.0f}°, tilt {tilt:.0f}°: acquire it at orbit {wanted.orbit_deg:.0f}°, "
                f"tilt {wanted.tilt_deg:.0f}°, or check the side and the order of the images"
            )
            sentence += ", or draw the aids more accurately" if known else ""
        return Check("view directions", self.over_deg <= 0.0, self.away_deg, wanted.within_deg, "°", f"{sentence}.")


def _axes_of_frame(views: Sequence[CalibratedView]) -> bool:
    """Return True where the axes of the views' frame are those of the patient: of plates (docs/conventions.md)."""
    return all(sight.frame_key is not None and sight.adjustment is None for sight in map(no_lines, views))


def _side_by_frame(document: ProcedureDocument, views: Sequence[CalibratedView]) -> bool:
    """Return True where a hip's side follows from its head and the axes of the views' frame."""
    return _axes_of_frame(views) and not {"head", HEAD_CENTRE}.isdisjoint(document.given)


def rules_of_bone(procedure: Procedure, views: Sequence[CalibratedView]) -> tuple[CheckRule, ...]:
    """Return the procedure's rules without that of the side, where only directions of the bone show it."""
    by_bone = len(procedure.document.directions) == 3 and not _side_by_frame(procedure.document, views)
    return tuple(rule for rule in procedure.checks if rule.check != "side" or not by_bone)


def assumed_axes(procedure: Procedure, views: Sequence[CalibratedView]) -> str:
    """Return what the procedure's checks along a block's axes take for granted, or "" for plates or without such."""
    if all(rule.check not in _ALONG_AXES for rule in rules_of_bone(procedure, views)):
        return ""
    return _ASSUMED if any(lines.adjustment is not None for lines in map(no_lines, views)) else ""


def angles_of(beam: np.ndarray) -> tuple[float, float]:
    """Return orbit and tilt, °, of a unit vector (3,): lateral, caudal, anterior."""
    return float(np.rad2deg(np.arctan2(beam[0], beam[2]))), float(np.rad2deg(np.arcsin(np.clip(-beam[1], -1.0, 1.0))))
