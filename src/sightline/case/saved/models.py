"""The forms of saved results, as models. `python -m sightline.case.saved FOLDER` writes the published schemas there.

Keys that are not named here may follow: readers pass over what they do not know.
"""

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, RootModel

from sightline.case.picks import Picks
from sightline.case.report.document import CalibratedViewDocument
from sightline.planning.document import CheckDocument, PlanDocument, TrajectoryDocument
from sightline.planning.procedures.document import ProcedureDocument

Number = Annotated[float, Field(allow_inf_nan=False)]
Pixel = tuple[Number, Number]
Point = tuple[Number, Number, Number]
Covariance = tuple[Pixel, Pixel]
_Row = tuple[Number, Number, Number, Number]
_Matrix = tuple[_Row, _Row, _Row, _Row]
_Six = tuple[Number, Number, Number, Number, Number, Number]
Shape = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
Site = Annotated[int, Field(ge=-4096, le=4096)]  # of a lattice: more than an image of the largest size can show
Digest = Annotated[str, Field(description="SHA-256 of the canonical JSON of all other keys.")]


class _Saved(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)

    digest: Digest


class RejectedDocument(BaseModel):
    """A candidate that is not a bead, or a detection without a label, and why."""

    uv_px: Pixel
    radius_px: Number
    reason: str


class SavedDetections(_Saved):
    """Beads found in one image, px."""

    schema_: Annotated[Literal["sightline-detections/1"], Field(alias="schema")]
    uv_px: tuple[Pixel, ...]
    radius_px: tuple[Number, ...]
    covariance_px2: tuple[Covariance, ...]
    kind: tuple[Literal["ball", "washer", "hole"], ...]
    contrast: tuple[Number, ...]
    image_shape: Shape
    rejected: tuple[RejectedDocument, ...]


class ObservationsDocument(BaseModel):
    """Labelled beads of one view, px; null where something is not known."""

    view: str
    ids: tuple[str, ...]
    uv_px: tuple[Pixel, ...]
    covariance_px2: tuple[Covariance, ...] | None
    mirrored: bool
    image_shape: Shape | None
    radius_px: tuple[Number, ...] | None
    rejected: tuple[RejectedDocument, ...] | None


class SavedObservations(ObservationsDocument, _Saved):
    """Labelled beads of one view."""

    schema_: Annotated[Literal["sightline-observations/1"], Field(alias="schema")]


class CArmDocument(BaseModel):
    """What is known of the C-arm."""

    source_detector_mm: Number
    pixel_mm: Number | None


class MadeFrom(BaseModel):
    """What `calibrate` was given: `frame` is the content of a frame file."""

    observations: ObservationsDocument
    frame: dict[str, Any]
    degree: int
    plate: Literal["xrii", "source"]
    mirrored_display: bool | None
    c_arm: CArmDocument | None


class SavedView(CalibratedViewDocument, _Saved):
    """One calibrated view, and what it was made from. Lengths in mm, CFCS."""

    schema_: Annotated[Literal["sightline-view/1"], Field(alias="schema")]
    made_from: MadeFrom


class SavedViews(RootModel[list[SavedView]]):
    """The calibrated views of a pair of images: views.json of `sightline demo`."""


class SavedMatrixView(_Saved):
    """A view of another system's matrix, as in OpenCV (docs/interop.md)."""

    schema_: Annotated[Literal["sightline-matrix-view/1"], Field(alias="schema")]
    view: str
    matrix: tuple[tuple[Number, Number, Number, Number], ...]


class MovementDocument(BaseModel):
    """What three or more views show of a movement between them, as `Movement`."""

    chi2: Number
    freedom: int
    information: tuple[tuple[Point, Point, Point], ...]
    shown: tuple[int, ...]
    redundancy: int


class PointsDocument(BaseModel):
    """N points, CFCS, mm, as `SpacePoints`. Null where something is not known; a gap that was not tested has a null
    `gap_sigma`."""

    xyz_mm: tuple[Point, ...]
    gap_mm: tuple[Number, ...]
    gap_tested: tuple[bool, ...]
    gap_sigma: tuple[Number | None, ...] | None
    joint_covariance_mm2: tuple[tuple[Number, ...], ...] | None
    budget_mm2: dict[str, tuple[tuple[Number, ...], ...]] | None
    inside_hull: tuple[bool, ...]
    method: str
    shift_mm: Number | None
    shift_sd_mm: Number | None
    gap_chi2: Number | None
    head_tested: bool = False
    upright: bool | None
    beads_near: dict[str, tuple[tuple[int, int, int], ...]] | None
    movement: MovementDocument | None = None


class SavedPoints(PointsDocument, _Saved):
    """N points in space."""

    schema_: Annotated[Literal["sightline-points/1"], Field(alias="schema")]


class SavedTrajectory(TrajectoryDocument, _Saved):
    """A planned wire: trajectory.json of `sightline demo`. `points`: entry and end with everything known of them."""

    model_config = ConfigDict(title="Sightline trajectory")

    schema_: Annotated[Literal["sightline-trajectory/1"], Field(alias="schema")]
    points: PointsDocument


class SavedPlan(PlanDocument, _Saved):
    """A plan with the keys of plan.json, and `asked`, what `plan` was given."""

    schema_: Annotated[Literal["sightline-plan/1"], Field(alias="schema")]
    views: Annotated[tuple[dict[str, Any], ...], Field(min_length=2)]
    asked: dict[str, Any]


class BoneViewDocument(BaseModel):
    """A view that a bone was registered to."""

    view: str
    focal_point_mm: Point
    pixels_sha256: str
    own_matrix: _Matrix
    along_beam_95_mm: Number | None


class SavedBonePose(_Saved):
    """Where a bone lies in calibrated images, as `RegisteredBone`: bone-pose.json of `sightline register-bone`."""

    schema_: Annotated[Literal["sightline-bone-pose/1"], Field(alias="schema")]
    matrix: _Matrix
    centre_mm: Point
    covariance: tuple[_Six, _Six, _Six, _Six, _Six, _Six] | None
    checks: Annotated[tuple[CheckDocument, ...], Field(min_length=1, max_length=200)]
    views: Annotated[tuple[BoneViewDocument, ...], Field(min_length=2)]
    volume_sha256: str


class SavedCheckShot(_Saved):
    """What a check shot found, as `CheckShot`."""

    schema_: Annotated[Literal["sightline-check-shot/1"], Field(alias="schema")]
    entry_mm: Point
    tip_mm: Point
    deviation_mm: tuple[Number, Number, Number, Number, Number]
    covariance_mm2: tuple[tuple[Number, ...], ...]
    across: tuple[Point, Point]
    length_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    bone_moved: tuple[tuple[Number, Number, Number, Number], ...]
    landmarks: int
    bow_mm: Number
    bow_sigma: Number
    residual_rms: Number
    outlier_sigma: Number
    checks: tuple[CheckDocument, ...]


class SavedGridMap(_Saved):
    """The distortion map of an image of a dot grid or a perforated sheet, as `GridMap`: fitted again when read."""

    schema_: Annotated[Literal["sightline-grid-map/1"], Field(alias="schema")]
    uv_px: tuple[Pixel, ...]
    index: tuple[tuple[Site, Site], ...]
    pattern: Literal["square", "hexagonal"]
    pitch_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    shape: Shape
    kind: Literal["ball", "hole"]
    left_out: int


PUBLISHED = {"views": SavedViews, "trajectory": SavedTrajectory, "procedure": ProcedureDocument, "picks": Picks}


def schema_text(name: str) -> str:
    """Return the published schema of one of PUBLISHED."""
    return json.dumps(PUBLISHED[name].model_json_schema(), indent=1) + "\n"
