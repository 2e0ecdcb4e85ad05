"""What a case holds of each stage's result: one function for what is recorded and for what is computed again."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.case.canonical import digest
from sightline.case.documents import check_document, view_document
from sightline.case.views import CalibratedImage
from sightline.detection import Detections, Observations
from sightline.imaging import Radiograph
from sightline.planning import Plan, plan
from sightline.planning.verdict import Limits


@dataclass(frozen=True, eq=False)
class Asked:
    """What a plan is made from besides its views: `entry_uv_px`, `end_uv_px` (2, 2), a row for each view, as picked;
    `landmarks_uv_px` (2, L, 2) or None, with L `landmark_names` or none. `kind`: of
    trajectory, where one was chosen. See `planning.plan` for the others.
    """

    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    pick_sd_px: float
    snapped: bool | Sequence[bool]
    landmarks_uv_px: np.ndarray | None = None
    landmark_names: tuple[str, ...] = ()
    limits: Limits | None = None
    kind: str | None = None

    @staticmethod
    def of(document: dict[str, Any]) -> "Asked":
        """From what `asked` made of one."""
        limits = document["limits"]
        return Asked(**{**document, "limits": None if limits is None else Limits(**limits)})

    def plan(self, views: "tuple[CalibratedImage, CalibratedImage]") -> Plan:
        """Raises what `planning.plan` raises."""
        return plan(
            [image.view for image in views],
            np.asarray(self.entry_uv_px),
            np.asarray(self.end_uv_px),
            pick_sd_px=self.pick_sd_px,
            snapped=self.snapped,
            landmarks_uv_px=None if self.landmarks_uv_px is None else np.asarray(self.landmarks_uv_px),
            limits=self.limits,
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
    return dict(vars(beads))


def labelled(observations: Observations, frame_key: str) -> dict[str, Any]:
    """`frame_key`: of the frame whose fiducials these are."""
    return {**vars(observations), "frame_key": frame_key}


def calibrated(image: CalibratedImage) -> dict[str, Any]:
    """Without the source's name, which may be a patient's."""
    document = view_document(image)
    del document["source"]
    return document


def planned(asked: Asked, made: Plan) -> dict[str, Any]:
    """What was asked, the picks as they were used, and what came of them."""
    used = [[pick.uv_px for pick in point] for point in made.picks]
    return {
        "asked": asked,
        "used_uv_px": {"entry": used[0], "end": used[1]},
        "go": made.verdict.go,
        "trajectory": made.trajectory.document(),
        "landmarks": made.landmarks_document(),
        "checks": [check_document(check) for check in made.verdict.checks],
    }
