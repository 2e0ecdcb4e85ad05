"""The report as JSON, whose schema is published."""

import json
from dataclasses import replace
from pathlib import Path

from sightline.case.report.content import NOTE, KeptExposure, Report
from sightline.case.report.document import ReportDocument, report_document, schema_text
from sightline.case.report.page import render

SCHEMA = Path(__file__).parents[2] / "docs" / "report.schema.json"


def test_the_published_schema_is_that_of_the_code() -> None:
    assert SCHEMA.read_text() == schema_text(), "python -m sightline.case.report.document > docs/report.schema.json"


def test_what_is_written_is_what_the_plan_states(report: Report) -> None:
    written = report_document(report, "C-7F3K-9QTM-2XWD").model_dump_json()
    read = ReportDocument.model_validate_json(written)
    assert read.case == "C-7F3K-9QTM-2XWD"
    assert read.go is report.plan.verdict.go
    assert list(read.trajectory.entry_mm) == report.plan.trajectory.entry_mm.tolist()
    assert read.trajectory.error_95 is not None
    assert read.trajectory.error_95.end_mm == report.plan.trajectory.end_error_95_mm
    assert [check.name for check in read.checks] == [check.name for check in report.plan.verdict.checks]
    assert [len(view.beads) for view in read.views] == [len(image.seen.observations) for image in report.images]
    assert len(read.landmarks) == 2
    # What the schema does not name is there, too.
    assert json.loads(written)["trajectory"]["budget_rms"] == report.plan.trajectory.document()["budget_rms"]


def test_exposures_are_in_page_and_document(report: Report) -> None:
    """And so is what is not known of them."""
    many = replace(report, exposures=[KeptExposure(f"{k:012d}.dcm", f"use {k}", frames=k) for k in range(1, 60)])
    page = render(many)
    document = json.loads(report_document(many).model_dump_json())
    for k in (1, 59):
        assert f"{k:012d}.dcm" in page
        assert f"use {k}" in page
        assert {"image": f"{k:012d}.dcm", "used": f"use {k}", "at": None, "frames": k} in document["exposures"]
    assert NOTE in " ".join(page.split())
    assert "neither is the dose" in schema_text()
