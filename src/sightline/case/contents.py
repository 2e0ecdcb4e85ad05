"""What a case holds of each stage's result: one function for what is recorded and for what is computed again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.case.canonical import digest, plain
from sightline.case.documents import check_document, view_document
from sightline.case.views import CalibratedImage
from sightline.checks import Limits
from sightline.detection import Detections, Observations
from sightline.errors import CaseError
from sightline.imaging import Radiograph
from sightline.planning import Aids, MatchingCurve, Plan, TrajectoryKind, matching_curve, plan
from sightline.planning import kind as kind_of
from sightline.planning.check_result import CheckShot
from sightline.planning.check_start import Landmarks

Pair = tuple[CalibratedImage, CalibratedImage]


@dataclass(frozen=True, eq=False)
class Asked:
    """What a plan is made from besides its views: `entry_uv_px`, `end_uv_px` (2, 2), a row for each view, as picked;
    `landmarks_uv_px` (2, L, 2) or None, with L `landmark_names` or none. `kind`: the key of one, None for any wire;
    `limits` where they are not the kind's. See `planning.plan` for the others.
    """

    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    pick_sd_px: float
    snapped: bool | Sequence[bool]
    landmarks_uv_px: np.ndarray | None = None
    landmark_names: tuple[str, ...] = ()
    limits: Limits | None = None
    kind: str | None = None
    side: str | None = None
    aids: Aids | None = None

    @staticmethod
    def of(document: dict[str, Any]) -> "Asked":
        """From the JSON of one. Before sides and aids were asked for, a plan was judged as any wire is, by the limits
        of its kind."""
        limits = document["limits"]
        fields: dict[str, Any] = {**document, "limits": None if limits is None else Limits(**limits)}
        made = Asked(**fields)
        if "side" not in document:
            return replace(made, kind=None, landmark_names=())
        return made if made.aids is None else replace(made, aids=Aids.of(document["aids"]))

    def plan(self, views: Pair) -> Plan:
        """Raises what `planning.plan` raises."""
        return self.plan_on([image.view for image in views])

    def plan_on(self, views: Sequence[CalibratedView], curve: Callable[..., MatchingCurve] = matching_curve) -> Plan:
        """The same on two calibrated views, PA first."""
        return plan(
            views,
            np.asarray(self.entry_uv_px),
            np.asarray(self.end_uv_px),
            pick_sd_px=self.pick_sd_px,
            snapped=self.snapped,
            landmarks_uv_px=None if self.landmarks_uv_px is None else np.reshape(self.landmarks_uv_px, (2, -1, 2)),
            landmark_names=self.landmark_names,
            kind=self.known_kind,
            side=self.side,
            aids=self.aids,
            curve=curve,
        )

    @property
    def known_kind(self) -> TrajectoryKind:
        """The kind, with the limits that hold. Raises UnusableInputError."""
        known = kind_of(self.kind or "free-wire")
        return known if self.limits is None else replace(known, limits=self.limits)


@dataclass(frozen=True, eq=False)
class CheckAsked:
    """What a check shot is measured from besides its images: the wire's width, and landmarks that were found again."""

    wire_mm: float
    landmarks: Landmarks

    @staticmethod
    def of(document: dict[str, Any]) -> "CheckAsked":
        """From what `verified` made of one."""
        known = document["landmarks"]
        before, after = (np.reshape(known[key], (2, -1, 2)) for key in ("planned_uv_px", "checked_uv_px"))
        return CheckAsked(document["wire_mm"], Landmarks(before, after, known["sd_px"]))

    def shot(self, made: Plan, planned: Pair, checked: Pair) -> CheckShot:
        """The wire, found in both check images, against the plan. Raises CaseError where one is no image, and what
        `find_wire` and `check_shot` raise."""
        from sightline.detection.wire import find_wire
        from sightline.planning.check_shot import check_shot
        from sightline.planning.expected_wire import expected_wire

        wires = []
        for image in checked:
            seen = image.seen
            if seen.image is None or seen.beads is None:
                raise CaseError("a check shot shows the wire in two images; a table of beads shows none")
            expected = expected_wire(image.view, made.trajectory, made.kind.limits.beyond_mm)
            wires.append(find_wire(seen.image, expected, self.wire_mm, seen.beads.uv_px, seen.beads.radius_px))
        before, after = ([image.view for image in pair] for pair in (planned, checked))
        return check_shot(
            made.trajectory, made.picks, before, after, wires, landmarks=self.landmarks, limits=made.kind.limits
        )


def acquired(original: str, image: Radiograph | None) -> dict[str, Any]:
    """Of an image, or of a table of beads, which has no pixels."""
    if image is None:
        return {"original": original}
    return {
        "original": original,
        "image_shape": image.shape,
        "dtype": image.pixels.dtype.name,
        "white": image.white,
        "pixels_sha256": digest(np.ascontiguousarray(image.pixels).tobytes()),
        "tags": image.tags,
    }


def detected(beads: Detections) -> dict[str, Any]:
    """Beads, and candidates that are none."""
    return plain(beads)


def labelled(observations: Observations, frame_key: str) -> dict[str, Any]:
    """`frame_key`: of the frame whose fiducials these are."""
    return {**plain(observations), "frame_key": frame_key}


def calibrated(image: CalibratedImage) -> dict[str, Any]:
    """Without the source, which the acquired entry names."""
    document = view_document(image)
    del document["source"]
    return document


def planned(asked: Asked, made: Plan) -> dict[str, Any]:
    """What was asked, the picks as they were used, and what came of them."""
    used = [[pick.uv_px for pick in point] for point in made.picks]
    return {
        "asked": asked,
        "used_uv_px": {"entry": used[0], "end": used[1]},
        **made.verdict_document(),
        "trajectory": made.trajectory.document(),
        "landmarks": made.landmarks_document(),
        "checks": [check_document(check) for check in made.verdict.checks],
    }


def verified(asked: CheckAsked, found: CheckShot | str) -> dict[str, Any]:
    """`found`: the check shot, or why it was refused."""
    return {"asked": asked, **({"refused": found} if isinstance(found, str) else found.document())}
