"""What is read of `plan.json`, with the limits of every value."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sightline.planning.results import State

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Point = tuple[Number, Number, Number]
Pixel = tuple[Number, Number]
Text = Annotated[str, Field(max_length=200)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0.0, le=1e3)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class TrajectoryPart(_Part):
    """Entry and end point, CFCS mm, with their joint covariance or None."""

    coordinates: Literal["CFCS"]
    entry_mm: Point
    end_mm: Point
    covariance_mm2: Annotated[list[list[Number]], Field(min_length=6, max_length=6)] | None


class CheckPart(_Part):
    """A check's name and whether it passed."""

    name: Text
    passed: bool


class BeadPart(_Part):
    """A ball of the frame."""

    id: Text
    view: Text
    plate: Text
    xyz_mm: Point


class FramePart(_Part):
    """The frame that the plan was made with."""

    name: Text
    serial: Text | None
    beads: Annotated[list[BeadPart], Field(max_length=2000)]


class SightPart(_Part):
    """A line of sight: from the X-ray source through a pick to the XRII plate, CFCS mm."""

    point: Text
    view: Text
    focal_point_mm: Point
    plate_mm: Point


class DrawnPart(_Part):
    """The plan in a view's raw image, px: the picks, and the wire as the view sees it (empty where it does not)."""

    entry_px: Pixel
    end_px: Pixel
    wire_px: Annotated[list[Pixel], Field(max_length=1000)]


class ViewPart(_Part):
    """A view, and the file of its image, named by its bytes."""

    view: Text
    source: Text


class LandmarkPart(_Part):
    """A point of the bone, CFCS mm."""

    xyz_mm: Point


class LimitsPart(_Part):
    """What the plan was judged by."""

    position_mm: Positive
    direction_deg: Positive
    beyond_mm: Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e3)]


class PlanDocument(_Part):
    """What is read of plan.json. Without `digest` and what goes with it it is of an earlier form; the last five are
    missing in plans without images' geometry."""

    go: bool
    verdict: State | None = None
    missing: Annotated[list[Annotated[str, Field(max_length=2000)]], Field(max_length=200)] = []
    kind: Text | None = None
    side: Literal["right", "left"] | None = None
    limits: LimitsPart | None = None
    digest: Text | None = None
    trajectory: TrajectoryPart
    checks: Annotated[list[CheckPart], Field(max_length=200)]
    landmarks: Annotated[list[LandmarkPart], Field(max_length=200)] = []
    frame: FramePart | None = None
    views: Annotated[list[ViewPart], Field(max_length=2)] = []
    plates: dict[str, dict[str, Any]] | None = None
    lines_of_sight: Annotated[list[SightPart], Field(max_length=200)] = []
    drawn: dict[str, DrawnPart] | None = None
