"""The report as JSON. Its schema is docs/report.schema.json, printed by `python -m sightline.case.report.document`.

Later versions may add keys, which readers must ignore. The keys named here do not change.
"""

import json
from typing import Any, Literal

from pydantic import ConfigDict, Field

from sightline.case.canonical import canonical
from sightline.case.journal.entry import versions
from sightline.case.report.content import NOTE, Report
from sightline.case.views import view_document
from sightline.planning import WirePlans
from sightline.planning.document import CheckDocument, OpenDocument, PlanDocument, Point
from sightline.planning.points.results import State


class FrameNamed(OpenDocument):
    """The calibration frame."""

    name: str
    serial: str | None


class BeadDocument(OpenDocument):
    """One bead: its measured centre, IDCS px, and its residual on the reference plane, mm."""

    id: str
    uv_px: tuple[float, float]
    residual_mm: tuple[float, float]
    used: bool


class CalibratedViewDocument(OpenDocument):
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


class ExposureDocument(OpenDocument):
    """An acquired image, by the first digits of its hash. `at`: UTC, when it was kept; null outside a case. `frames`:
    the number of frames exposed for it, in a run or an average."""

    image: str
    used: str
    at: str | None
    frames: int


class WiresDocument(OpenDocument):
    """The wires that were planned together with this one: by key the verdict on each in the order of drilling, the
    verdict on all of them, and the relations between them."""

    each: dict[str, State]
    verdict: State
    missing: tuple[str, ...]
    relations: tuple[CheckDocument, ...]


class ReportDocument(PlanDocument):
    """The report of one plan. `case`: the number of its case, the only identity in it; null outside a case.

    `drilled`: null until a robot has carried out the plan.
    """

    model_config = ConfigDict(title="Sightline report")

    report: Literal[1] = Field(description="The version of this schema.")
    case: str | None
    title: str
    versions: dict[str, str]
    provenance: dict[str, str]
    frame: FrameNamed
    views: tuple[CalibratedViewDocument, ...]
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
        "exposures": report.exposures,
        "drilled": None if report.drilled is None else report.drilled.document(),
        "wires": _wires(report.wires),
    }
    return ReportDocument.model_validate_json(canonical(stated))


def _wires(made: WirePlans | None) -> dict[str, Any] | None:
    if made is None:
        return None
    return {
        "each": {key: plan.verdict.state for key, plan in made.plans.items()},
        "verdict": made.verdict.state,
        "missing": made.verdict.missing,
        "relations": [vars(check) for check in made.relations],
    }


def schema_text() -> str:
    """Return the published JSON schema."""
    return json.dumps(ReportDocument.model_json_schema(), indent=1) + "\n"


if __name__ == "__main__":
    print(schema_text(), end="")
