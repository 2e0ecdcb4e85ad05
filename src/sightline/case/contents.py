"""The content of each kind of entry. Recording and replay use the same functions, so that their results compare."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.view import CalibratedView
from sightline.case.canonical import plain, with_null
from sightline.case.views import CalibratedImage, view_document
from sightline.common.checks import Limits
from sightline.detection import Detections, Observations
from sightline.errors import CaseError, UnusableInputError
from sightline.from_images.interlocking import NailDrawn, plan_found_holes, plan_holes
from sightline.imaging import Radiograph
from sightline.planning import (
    Aids,
    Axis,
    Hole,
    MatchingCurve,
    Plan,
    Procedure,
    WirePicks,
    WirePlans,
    matching_curve,
    plan,
    plan_wires,
)
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.adjustment import on_patient
from sightline.planning.check.result import CheckShot
from sightline.planning.check.wires import Beforehand, Landmarks, PlacedWire, picked_wire
from sightline.planning.points.picks import PickArrays
from sightline.planning.points.solution import Method
from sightline.planning.procedures.procedure import kept

if TYPE_CHECKING:
    from sightline.planning.check.shot import DrillShot

Pair = tuple[CalibratedImage, CalibratedImage]
Images = tuple[CalibratedImage, ...]  # of a plan: PA, lateral, and the third where there is one
_RARE = ("others", "placed", "nail", "method", "bone")  # of a request: written only where they differ from the default


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """The inputs of a plan besides its V views.

    `entry_uv_px`, `end_uv_px`: (V, 2) picks, one row per view. `landmarks_uv_px`: (V, L, 2) or None, with L
    `landmark_names` or none; NaN where a view does not show a point. `kind`: the key of a procedure, None for a free
    wire; `procedure`: the content of its file where that is not shipped. `limits`: set where they replace those of the
    procedure. `others`: picks of the procedure's other wires where all are planned together, `placed`: its wires that
    are in the bone already, both by key; None for a wire alone. `nail`: then the points are those of its holes, which
    are found in the images; of each hole that is planned the click stands for both points. `bone`: registered in these
    images. See `planning.plan` for the others.
    """

    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    pick_sd_px: float
    snapped: bool | Sequence[bool]
    landmarks_uv_px: np.ndarray | None = None
    landmark_names: tuple[str, ...] = ()
    limits: Limits | None = None
    kind: str | None = None
    procedure: dict[str, Any] | None = None
    side: str | None = None
    aids: Aids | None = None
    others: Mapping[str, WirePicks] | None = None
    placed: Mapping[str, Axis] | None = None
    nail: NailDrawn | None = None
    method: Method = "weighted"
    bone: RegisteredBone | None = None

    @staticmethod
    def of(document: dict[str, Any]) -> "PlanRequest":
        """Return the request that an entry holds.

        Entries without a side are from versions that judged every plan as a free wire, by the limits of its kind.
        """
        limits = document["limits"]
        fields: dict[str, Any] = {**document, "limits": None if limits is None else Limits(**limits)}
        for name, read in (("others", lambda written: WirePicks(**written)), ("placed", _placed)):
            if fields.get(name) is not None:
                fields[name] = {key: read(written) for key, written in fields[name].items()}
        if fields.get("nail") is not None:
            fields["nail"] = NailDrawn.of(fields["nail"])
        if fields.get("bone") is not None:
            fields["bone"] = RegisteredBone.of(fields["bone"])
        request = PlanRequest(**fields)
        if "side" not in document:
            return replace(request, kind=None, landmark_names=())
        return request if request.aids is None else replace(request, aids=Aids.of(document["aids"]))

    def plan(self, views: Sequence[CalibratedImage]) -> Plan:
        """Make the plan on the calibrated images, PA first. Raises what `plan_wires` and `planning.plan` raise."""
        if self.nail is not None:
            return self.plan_wires(views).plans[self.known_kind.wire.key]
        _refuse_other_images(self.bone, views)
        return self.plan_on([image.view for image in views])

    def plan_wires(self, images: Sequence[CalibratedImage]) -> WirePlans:
        """Make the plans of this wire and `others` on the calibrated images; holes of a nail are found in them.

        Raises what `plan_holes` and `planning.plan_wires` raise.
        """
        _refuse_other_images(self.bone, images)
        views = [image.view for image in images]
        if self.nail is None:
            return self.plan_wires_on(views)
        shown = [image.seen.image for image in images if image.seen.image is not None]
        if len(shown) < len(images):
            raise UnusableInputError("the holes of a nail are found in images; a table of beads shows no nail")
        kind, shared = self.known_kind, self._shared(len(views), matching_curve)
        return plan_holes(views, shown, self.nail, procedure=kind.document, side=self.side, **shared)

    def plan_holes_on(
        self,
        views: Sequence[CalibratedView],
        holes: Mapping[str, Hole],
        curve: Callable[..., MatchingCurve] = matching_curve,
    ) -> WirePlans:
        """Make the plans of a nail's holes that were found in the images of calibrated views, as `plan_wires` does.

        Raises what `plan_found_holes` raises.
        """
        document, drilled = self.known_kind.document, () if self.nail is None else self.nail.drilled
        shared = self._shared(len(views), curve)
        return plan_found_holes(views, holes, procedure=document, drilled=drilled, side=self.side, **shared)

    def plan_on(self, views: Sequence[CalibratedView], curve: Callable[..., MatchingCurve] = matching_curve) -> Plan:
        """Make the plan on calibrated views, PA first. Raises what `planning.plan` raises."""
        if self.others is not None:
            return self.plan_wires_on(views, curve).plans[self.known_kind.wire.key]
        picks = self._picks
        return plan(
            views,
            picks.entry_uv_px,
            picks.end_uv_px,
            snapped=picks.snapped,
            procedure=self.known_kind,
            side=self.side,
            **self._shared(len(views), curve),
        )

    def plan_wires_on(
        self, views: Sequence[CalibratedView], curve: Callable[..., MatchingCurve] = matching_curve
    ) -> WirePlans:
        """Make the plans of this wire and `others` on calibrated views. Raises UnusableInputError for a nail, and what
        `planning.plan_wires` raises."""
        if self.nail is not None:
            raise UnusableInputError("the holes of a nail are found in images, not on views alone; use `plan_wires`")
        kind = self.known_kind
        return plan_wires(
            views,
            {kind.wire.key: self._picks, **(self.others or {})},
            procedure=kind.document,
            placed=self.placed,
            side=self.side,
            **self._shared(len(views), curve),
        )

    def of_wire(self, key: str) -> "PlanRequest":
        """Return the same request as that of another wire. Raises KeyError where that wire is not planned with it."""
        kind, others = self.known_kind, dict(self.others or {})
        if key == kind.wire.key:
            return self
        picks = others.pop(key)
        own = {"entry_uv_px": picks.entry_uv_px, "end_uv_px": picks.end_uv_px, "snapped": picks.snapped}
        others[kind.wire.key] = self._picks
        return replace(self, **own, kind=Procedure.of(kind.document, key).key, others=others)

    @property
    def _picks(self) -> WirePicks:
        entry, end = (np.array(uv_px, dtype=np.float64) for uv_px in (self.entry_uv_px, self.end_uv_px))
        return WirePicks(entry, end, self.snapped)

    def _shared(self, views: int, curve: Callable[..., MatchingCurve]) -> dict[str, Any]:
        """Return the arguments of `plan` that hold for all wires."""
        marks = self.landmarks_uv_px
        return {
            "pick_sd_px": self.pick_sd_px,
            "landmarks_uv_px": None if marks is None else np.array(marks, dtype=np.float64).reshape(views, -1, 2),
            "landmark_names": self.landmark_names,
            "aids": self.aids,
            "method": self.method,
            "curve": curve,
            "bone": self.bone,
        }

    @property
    def known_kind(self) -> Procedure:
        """The procedure with the limits in force. Raises UnusableInputError for an unknown one."""
        return kept(self.kind or "free-wire", self.procedure).with_limits(self.limits)


def _refuse_other_images(bone: RegisteredBone | None, images: Sequence[CalibratedImage]) -> None:
    """Raise UnusableInputError unless the bone was registered in these images."""
    if bone is None:
        return
    shown = {image.name: image.seen.image for image in images}
    if None in shown.values():
        raise UnusableInputError("a table of beads shows no bone; give the images in which the bone was registered")
    bone.refuse_other_images({name: image.pixels_sha256 for name, image in shown.items() if image is not None})


def _placed(document: dict[str, Any]) -> Axis:
    """Return a placed wire; entries of earlier versions do not hold its picks."""
    ends, stated = np.array(document["ends_mm"]), document["covariance_mm2"]
    covariance = None if stated is None else np.array(stated)
    picks = document.get("picks")
    return Axis(ends, covariance) if picks is None else PlacedWire(ends, covariance, PickArrays(*map(np.array, picks)))


@dataclass(frozen=True, eq=False)
class CheckRequest:
    """The inputs of a check shot besides its images: the wire's diameter, the landmarks picked in both pairs, and the
    plan's bone, registered in these images."""

    wire_mm: float
    landmarks: Landmarks
    bone: RegisteredBone | None = None

    @staticmethod
    def of(document: dict[str, Any]) -> "CheckRequest":
        """Return the request that an entry holds, as `verified` wrote it."""
        known = document["landmarks"]
        before, after = (np.reshape(known[key], (2, -1, 2)) for key in ("planned_uv_px", "checked_uv_px"))
        bone = document.get("bone")
        bone = None if bone is None else RegisteredBone.of(bone)
        return CheckRequest(document["wire_mm"], Landmarks(before, after, known["sd_px"]), bone)

    def document(self) -> dict[str, Any]:
        """Return the request as an entry holds it."""
        return {key: value for key, value in vars(self).items() if value is not None}

    def shot(
        self,
        made: Plan,
        planned: Sequence[CalibratedImage],
        checked: Sequence[CalibratedImage],
        others_mm: Sequence[np.ndarray] = (),
    ) -> CheckShot:
        """Find the wire in both check images and compare it with the plan; `others_mm`: as of `pipeline.check_shot`.

        Raises CaseError if a check view is a table of beads, and what `find_planned_wire` and `check_shot` raise.
        """
        from sightline.from_images.pipeline import find_planned_wire, known_by
        from sightline.planning.check.shot import check_shot

        _refuse_other_images(self.bone, checked)
        before, after = ([image.view for image in pair] for pair in (planned, checked))
        known, size = known_by(made, self.bone, after), self.wire_mm
        wires = [
            find_planned_wire(made, *_with_wire(shown), shown.view, size, others_mm, known=known) for shown in checked
        ]
        return check_shot(made.to_check(before), after, wires, landmarks=self.landmarks, known=known)


@dataclass(frozen=True, eq=False)
class DrillShotRequest:
    """The inputs of a shot while drilling besides its images: `check` as of a check shot, `tip_mm` as of `drill_shot`.

    `straight`: the wire is in its guide, in ALIGNED. `movement` (4, 4), `covariance` (6, 6): as of `Beforehand`; a
    matrix, so that replay computes with the recorded numbers; None where the images' frame is fixed to the patient, of
    which encoders say nothing. `wire_uv_px` (2, M, 2): points on the wire's centre line picked in both images, the tip
    last, with the error of the landmarks' picks; without them the wire is found.
    """

    check: CheckRequest
    tip_mm: float
    straight: bool
    movement: np.ndarray | None
    covariance: np.ndarray | None
    wire_uv_px: np.ndarray | None = None

    @staticmethod
    def of(document: dict[str, Any]) -> "DrillShotRequest":
        """Return the request that an entry holds, as `document` wrote it."""
        rest = {key: value for key, value in document.items() if key not in ("wire_mm", "landmarks")}
        for key in ("movement", "covariance", "wire_uv_px"):
            rest[key] = None if rest[key] is None else np.array(rest[key], dtype=np.float64)
        return DrillShotRequest(CheckRequest.of(document), **rest)

    def document(self) -> dict[str, Any]:
        """Return the request as an entry holds it."""
        return {**self.check.document(), **{key: value for key, value in vars(self).items() if key != "check"}}

    def shot(
        self,
        made: Plan,
        planned: Sequence[CalibratedImage],
        taken: Sequence[CalibratedImage],
        others_mm: Sequence[np.ndarray] = (),
    ) -> "DrillShot":
        """Find the wire in both images and compare it with the plan; `others_mm`, and what is raised, as of
        `CheckRequest.shot`."""
        from sightline.detection.wire import find_wire
        from sightline.from_images.pipeline import expected_wires
        from sightline.planning.check.shot import drill_shot
        from sightline.planning.check.wires import BEFORE_MM, GUIDED_MM, expected_wire, nail_px

        trajectory, hole, limits, wires = made.trajectory, made.hole, made.kind.limits, []
        before, after = ([image.view for image in pair] for pair in (planned, taken))
        if self.movement is None or self.covariance is None:
            known = on_patient((before, after), self.check.landmarks, straight=self.straight)
        else:
            known = Beforehand(RigidTransform.from_matrix(self.movement), self.covariance, self.straight)
        beyond_mm = self.tip_mm - trajectory.length_mm
        before_mm = (GUIDED_MM if self.straight or hole is not None else BEFORE_MM) + limits.before_mm
        for shown, picked in zip(taken, (None, None) if self.wire_uv_px is None else self.wire_uv_px, strict=True):
            if picked is not None:
                wires.append(picked_wire(picked, self.check.landmarks.sd_px))
                continue
            image, beads = _with_wire(shown)
            path = expected_wire(shown.view, known.movement.apply(trajectory.points.xyz_mm), beyond_mm, before_mm)
            others = expected_wires([known.movement.apply(line) for line in others_mm], shown.view)
            covered = () if hole is None else [nail_px(shown.view, hole, known.movement)]
            wires.append(find_wire(image, path, self.check.wire_mm, beads, others=others, covered_px=covered))
        known_marks = self.check.landmarks
        return drill_shot(made.to_check(before), after, wires, tip_mm=self.tip_mm, known=known, landmarks=known_marks)


def _with_wire(image: CalibratedImage) -> tuple[Radiograph, Detections]:
    """Return the pixels and beads of an image that shows a wire. Raises CaseError for a table of beads."""
    seen = image.seen
    if seen.image is None or seen.beads is None:
        raise CaseError("a check shot needs two images that show the wire; a table of beads shows no wire")
    return seen.image, seen.beads


def acquired(original: str, image: Radiograph | None) -> dict[str, Any]:
    """Return the content of an acquired entry; `image` is None for a table of beads, which has no pixels."""
    if image is None:
        return {"original": original}
    return {
        "original": original,
        "image_shape": image.shape,
        "dtype": image.pixels.dtype.name,
        "white": image.white,
        "pixels_sha256": image.pixels_sha256,
        "tags": image.tags,
    }


def detected(beads: Detections) -> dict[str, Any]:
    """Return the content of a detected entry: beads and rejected candidates."""
    return plain(beads)


def labelled(observations: Observations, frame_key: str) -> dict[str, Any]:
    """Return the content of a labelled entry; `frame_key` identifies the frame whose fiducials were labelled."""
    return {**plain(observations), "frame_key": frame_key}


def calibrated(image: CalibratedImage) -> dict[str, Any]:
    """Return the content of a calibrated entry, without the source, which the acquired entry names."""
    document = view_document(image)
    del document["source"]
    return document


def planned(asked: PlanRequest, made: Plan) -> dict[str, Any]:
    """Return the content of a planned entry: the request, the picks as they were used, and the plan."""
    used = [[with_null(pick.uv_px) for pick in point] for point in made.picks]
    return {
        "asked": {
            key: value
            for key, value in with_null(asked).items()
            if key not in _RARE or value != getattr(PlanRequest, key)
        },
        "used_uv_px": {"entry": used[0], "end": used[1]},
        **made.document(),
    }


def shot(asked: CheckRequest | DrillShotRequest, result: "CheckShot | DrillShot | str") -> dict[str, Any]:
    """Return the content of the entry of a check shot, or of a shot while drilling.

    `result` is the shot, or why it was refused.
    """
    return {"asked": asked.document(), **({"refused": result} if isinstance(result, str) else result.document())}
