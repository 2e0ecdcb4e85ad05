"""A plan as JSON: one model for saved plans, entries of a case, `plan.json`, exports and reports.

Later versions may add keys, which readers must ignore. Keys that older versions did not write have defaults.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sightline.planning.points.results import State

# Bounds of what is read [ours]: lengths beyond 100 m, and texts and lists longer than any plan writes, are refused.
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Length = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e3)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0.0, le=1e3)]
Point = tuple[Number, Number, Number]
Pixel = tuple[Number, Number]
Text = Annotated[str, Field(max_length=200)]
Sentence = Annotated[str, Field(max_length=2000)]
_MOST = Field(max_length=200)
SOLID = "solid"  # `BeadOfFrame.plate` of a ball of a solid


class OpenDocument(BaseModel):
    """A part of a document that may have more keys."""

    model_config = ConfigDict(extra="allow", frozen=True)


class CheckDocument(OpenDocument):
    """One check: a value (`figure`) and its limit, both in `unit`; null where there is none."""

    name: Text
    passed: bool
    figure: float | None = None
    limit: float | None = None
    unit: Text = ""
    sentence: Sentence = ""
    code: Text | None = Field(default=None, description="What the check is about, for programs; not in version 0.1.0.")
    missing: bool = Field(default=False, description="The check failed because an input is missing.")
    view: Text = Field(default="", description="The view that the check is about.")
    error_95: float | None = Field(default=None, description="95 % error of the value, where it is judged with it.")
    is_minimum: bool | None = Field(default=None, description="Whether the limit is a lower one, where that is stated.")


class ErrorBounds(OpenDocument):
    """Bounds that each error stays below with a probability of 95 %."""

    entry_mm: float
    end_mm: float
    direction_deg: float


class TrajectoryDocument(OpenDocument):
    """The planned wire, CFCS, mm, with the joint covariance (6, 6) of entry and end. It and `error_95` are null if the
    error of a view is unknown."""

    coordinates: Literal["CFCS"]
    entry_mm: Point
    end_mm: Point
    direction: Point
    length_mm: float
    covariance_mm2: Annotated[list[list[Number]], Field(min_length=6, max_length=6)] | None
    error_95: ErrorBounds | None
    gap_mm: tuple[float, float]
    gap_tested: tuple[bool, bool]


class ProcedureNamed(OpenDocument):
    """The procedure that was planned: its name, and its file's key with a hash of the content."""

    name: Text
    fingerprint: Text


class LimitsDocument(OpenDocument):
    """The limits that a plan was judged by: of its 95 % errors, how far past its end point it may be drilled, and how
    far before its entry point bone may begin."""

    position_mm: Positive
    direction_deg: Positive
    beyond_mm: Length
    before_mm: Length = 0.0


class ImplantDocument(OpenDocument):
    """The implant of the catalogue that fits the wire, mm and °; null where none fits or it is not known."""

    length_mm: float | None
    plate_angle_deg: float | None
    sentence: Sentence


class AlongDocument(OpenDocument):
    """How far entry and end could be wrong along a line of sight before a check of the bone fails; null if no check
    would detect it."""

    entry: float | None
    end: float | None


class LandmarkDocument(OpenDocument):
    """A point of the bone that both views show; `name` is null if it has none."""

    name: Text | None = None
    xyz_mm: Point
    gap_mm: float
    gap_sigma: float | None
    residual_px: dict[str, tuple[float, float] | None] | None = Field(
        default=None,
        description="With three views: by view the pick less the landmark's projection; null where it was not picked.",
    )


class PlanDocument(OpenDocument):
    """A plan. `go`: true only if every check passed; a person decides. `verdict`: "incomplete" if nothing but the
    `missing` parts stands against the plan. `limits`: what the plan was judged by. `unchecked_relations`: names of this
    wire's relations to others that were not checked; null for a procedure's only wire. Plans from before version 0.1.0
    lack verdict, kind and limits.
    """

    go: bool
    verdict: State | None = None
    missing: Annotated[tuple[Sentence, ...], _MOST] = ()
    noticed_along_mm: AlongDocument | None = None
    kind: Text | None = None
    procedure: ProcedureNamed | None = None
    side: Literal["right", "left"] | None = None
    limits: LimitsDocument | None = None
    trajectory: TrajectoryDocument
    landmarks: Annotated[tuple[LandmarkDocument, ...], _MOST] = ()
    implant: ImplantDocument | None = None
    hole: dict[str, Any] | None = Field(default=None, description="The measured hole of a nail that is drilled.")
    checks: Annotated[tuple[CheckDocument, ...], _MOST]
    unchecked_relations: Annotated[tuple[Text, ...], _MOST] | None = None


class BeadOfFrame(OpenDocument):
    """A ball of the frame."""

    id: Text
    view: Text
    plate: Text
    xyz_mm: Point


class FrameReference(OpenDocument):
    """The frame that the plan was made with; `fingerprint`: of its file, "" in plans of older versions."""

    name: Text
    serial: Text | None
    fingerprint: Text = ""
    beads: Annotated[tuple[BeadOfFrame, ...], Field(max_length=2000)]


class SightDocument(OpenDocument):
    """A line of sight: from the X-ray source through a pick to the XRII plate, CFCS mm."""

    point: Text
    view: Text
    focal_point_mm: Point
    plate_mm: Point


class DrawnDocument(OpenDocument):
    """The plan in a view's raw image, px: the picks, and the projected wire, empty where it could not be projected."""

    entry_px: Pixel
    end_px: Pixel
    wire_px: Annotated[tuple[Pixel, ...], Field(max_length=1000)]


class ViewNamed(OpenDocument):
    """A view, and the name that a case gives the file of its image."""

    view: Text
    source: Text = ""


class PlanFileDocument(PlanDocument):
    """plan.json: a plan with its views and what an export needs. `all_wires`: the verdict on all wires of the
    procedure, where this is one of several that were planned together. `digest`: not in plans from before 0.1.0."""

    all_wires: State | None = None
    digest: Text | None = None
    views: Annotated[tuple[ViewNamed, ...], Field(max_length=3)] = ()
    frame: FrameReference | None = None
    plates: dict[str, dict[str, Any]] | None = None
    lines_of_sight: Annotated[tuple[SightDocument, ...], _MOST] = ()
    drawn: dict[str, DrawnDocument] | None = None
