"""The parts of `plan.json` that are read back, with limits for every value."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sightline.planning.points.results import State

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Point = tuple[Number, Number, Number]
Pixel = tuple[Number, Number]
Text = Annotated[str, Field(max_length=200)]
SOLID = "solid"  # `BeadPart.plate` of a ball of a solid
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0.0, le=1e3)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class TrajectoryPart(_Part):
    """Entry and end point, CFCS mm, with their joint covariance (6, 6) or None."""

    coordinates: Literal["CFCS"]
    entry_mm: Point
    end_mm: Point
    covariance_mm2: Annotated[list[list[Number]], Field(min_length=6, max_length=6)] | None


class CheckPart(_Part):
    """A check's name and code, and whether it passed. Version 0.1.0 wrote no codes."""

    name: Text
    passed: bool
    code: Text | None = None


class BeadPart(_Part):
    """A ball of the frame."""

    id: Text
    view: Text
    plate: Text
    xyz_mm: Point


class PlanFramePart(_Part):
    """The frame that the plan was made with; `fingerprint`: of its file, "" in plans of older versions."""

    name: Text
    serial: Text | None
    fingerprint: Text = ""
    beads: Annotated[list[BeadPart], Field(max_length=2000)]


class SightPart(_Part):
    """A line of sight: from the X-ray source through a pick to the XRII plate, CFCS mm."""

    point: Text
    view: Text
    focal_point_mm: Point
    plate_mm: Point


class DrawnPart(_Part):
    """The plan in a view's raw image, px: the picks, and the projected wire, empty where it could not be projected."""

    entry_px: Pixel
    end_px: Pixel
    wire_px: Annotated[list[Pixel], Field(max_length=1000)]


class ViewPart(_Part):
    """A view, and the name that a case gives the file of its image."""

    view: Text
    source: Text


class LandmarkPart(_Part):
    """A point of the bone, CFCS mm."""

    xyz_mm: Point


class LimitsPart(_Part):
    """The limits that the plan was judged by."""

    position_mm: Positive
    direction_deg: Positive
    beyond_mm: Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e3)]
    before_mm: Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e3)] = 0.0


class ProcedurePart(_Part):
    """The procedure that was planned: its name and the fingerprint of its file."""

    name: Text
    fingerprint: Text


class PlanDocument(_Part):
    """The parts of plan.json that are read back. Older versions wrote no `verdict`, `kind`, `limits` and `digest`;
    plans without the geometry of images lack the last five. `all_wires`: the verdict on all wires of the procedure,
    where this is one of several that were planned together. `unchecked_relations`: names of this wire's relations to
    others that were not checked; None in plans of a procedure's only wire, and of older versions."""

    go: bool
    all_wires: State | None = None
    unchecked_relations: Annotated[list[Text], Field(max_length=200)] | None = None
    verdict: State | None = None
    missing: Annotated[list[Annotated[str, Field(max_length=2000)]], Field(max_length=200)] = []
    kind: Text | None = None
    procedure: ProcedurePart | None = None
    side: Literal["right", "left"] | None = None
    limits: LimitsPart | None = None
    digest: Text | None = None
    trajectory: TrajectoryPart
    checks: Annotated[list[CheckPart], Field(max_length=200)]
    landmarks: Annotated[list[LandmarkPart], Field(max_length=200)] = []
    frame: PlanFramePart | None = None
    views: Annotated[list[ViewPart], Field(max_length=3)] = []
    plates: dict[str, dict[str, Any]] | None = None
    lines_of_sight: Annotated[list[SightPart], Field(max_length=200)] = []
    drawn: dict[str, DrawnPart] | None = None
