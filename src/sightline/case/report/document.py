"""The report as JSON. Its schema is docs/report.schema.json, printed by `python -m sightline.case.report.document`.

Later versions may add keys, which readers must ignore. The keys named here do not change.
"""

import json
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sightline.case.canonical import canonical
from sightline.case.documents import check_document, view_document
from sightline.case.journal.entry import versions
from sightline.case.report.content import Report
from sightline.case.report.exposures import NOTE
from sightline.planning import WirePlans
from sightline.planning.points.results import State

Point = tuple[float, float, float]


class _Open(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)


class CheckDocument(_Open):
    """One check: a value (`figure`) and its limit, both in `unit`; null where there is none."""

    name: str
    passed: bool
    figure: float | None
    limit: float | None
    unit: str
    sentence: str
    code: str | None = Field(default=None, description="What the check is about, for programs; not in version 0.1.0.")
    missing: bool = Field(default=False, description="The check failed because an input is missing.")
    view: str = Field(default="", description="The view that the check is about.")


class FrameNamed(_Open):
    """The calibration frame."""

    name: str
    serial: str | None


class BeadDocument(_Open):
    """One bead: its measured centre, IDCS px, and its residual on the reference plane, mm."""

    id: str
    uv_px: tuple[float, float]
    residual_mm: tuple[float, float]
    used: bool


class CalibratedViewDocument(_Open):
    """One calibrated view; lengths in mm, CFCS. Rms values are per axis."""

    view: str
    method: str
    mirrored: bool
    focal_point_mm: Point
    residual_rms_mm: float
    leave_one_out_rms_mm: float | None
    left_out: tuple[str, ...]
    beads: tuple[BeadDocument, ...]
    checks: tuple[CheckDocument, ...]


class ErrorBounds(_Open):
    """Bounds that each error stays below with a probability of 95 %."""

    entry_mm: float
    end_mm: float
    direction_deg: float


class TrajectoryDocument(_Open):
    """The planned wire, CFCS, mm. `error_95` is null if the error of a view is unknown."""

    coordinates: Literal["CFCS"]
    entry_mm: Point
    end_mm: Point
    direction: Point
    length_mm: float
    error_95: ErrorBounds | None
    gap_mm: tuple[float, float]
    gap_tested: tuple[bool, bool]


class ProcedureNamed(_Open):
    """The procedure that was planned: its name, and its file's key with a hash of the content."""

    name: str
    fingerprint: str


class LimitsDocument(_Open):
    """The limits that a plan was judged by: of its 95 % errors, how far past its end point it may be drilled, and how
    far before its entry point bone may begin."""

    position_mm: float
    direction_deg: float
    beyond_mm: float
    before_mm: float = 0.0


class ImplantDocument(_Open):
    """The implant of the catalogue that fits the wire, mm and °; null where none fits or it is not known."""

    length_mm: float | None
    plate_angle_deg: float | None
    sentence: str


class AlongDocument(_Open):
    """How far entry and end could be wrong along a line of sight before a check of the bone fails; null if no check
    would detect it."""

    entry: float | None
    end: float | None


class LandmarkDocument(_Open):
    """A point of the bone that both views show; `name` is null if it has none."""

    name: str | None
    xyz_mm: Point
    gap_mm: float
    gap_sigma: float | None
    residual_px: dict[str, tuple[float, float] | None] | None = Field(
        default=None,
        description="With three views: by view the pick less the landmark's projection; null where it was not picked.",
    )


class ExposureDocument(_Open):
    """An acquired image, by the first digits of its hash. `at`: UTC, when it was kept; null outside a case. `frames`:
    the number of frames exposed for it, in a run or an average."""

    image: str
    used: str
    at: str | None
    frames: int


class WiresDocument(_Open):
    """The wires that were planned together with this one: by key the verdict on each in the order of drilling, the
    verdict on all of them, and the relations between them."""

    each: dict[str, State]
    verdict: State
    missing: tuple[str, ...]
    relations: tuple[CheckDocument, ...]


class ReportDocument(_Open):
    """The report of one plan. `case`: the number of its case, the only identity in it; null outside a case.

    `go`: true only if every check passed; a person decides. `verdict`: "incomplete" if nothing but the `missing` parts
    stands against the plan. `limits`: what the plan was judged by. `drilled`: null until a robot has carried out the
    plan.
    """

    model_config = ConfigDict(title="Sightline report")

    report: Literal[1] = Field(description="The version of this schema.")
    case: str | None
    title: str
    versions: dict[str, str]
    provenance: dict[str, str]
    frame: FrameNamed
    views: tuple[CalibratedViewDocument, ...]
    go: bool
    verdict: State
    missing: tuple[str, ...]
    noticed_along_mm: AlongDocument
    kind: str
    procedure: ProcedureNamed
    side: str | None
    limits: LimitsDocument
    trajectory: TrajectoryDocument
    landmarks: tuple[LandmarkDocument, ...]
    implant: ImplantDocument | None
    checks: tuple[CheckDocument, ...]
    exposures: tuple[ExposureDocument, ...] = Field(description=NOTE)
    drilled: dict[str, Any] | None
    wires: WiresDocument | None = Field(default=None, description="Null for the plan of a wire alone.")


def report_document(report: Report, case_number: str | None = None) -> ReportDocument:
    """Return the JSON document of a report."""
    plan = report.plan
    stated = {
        "report": 1,
        "case": case_number,
        "title": report.title,
        "versions": versions(),
        "provenance": report.provenance,
        "frame": {"name": report.frame.name, "serial": report.frame.serial},
        "views": [view_document(image) for image in report.images],
        **plan.document(),
        "checks": [check_document(check) for check in plan.verdict.checks],
        "exposures": report.exposures,
        "drilled": None if report.drilled is None else report.drilled.document(),
        "wires": _wires(report.wires),
    }
    return ReportDocument.model_validate_json(canonical(stated))


def _wires(made: WirePlans | None) -> dict[str, Any] | None:
    if made is None:
        return None
    return {
        "each": {key: one.verdict.state for key, one in made.plans.items()},
        "verdict": made.verdict.state,
        "missing": made.verdict.missing,
        "relations": [check_document(check) for check in made.relations],
    }


def schema_text() -> str:
    """Return the published JSON schema."""
    return json.dumps(ReportDocument.model_json_schema(), indent=1) + "\n"


if __name__ == "__main__":
    print(schema_text(), end="")
