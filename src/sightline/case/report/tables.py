"""The texts and rounded numbers of a report as template context."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sightline.case.report import drilled
from sightline.case.report.charts import Bar
from sightline.case.report.content import NOTE, Compared, Refused, Report
from sightline.common.checks import Check, CheckCode, failed
from sightline.planning.check.result import CheckShot
from sightline.planning.points.results import Verdict
from sightline.planning.wires import judge_measured

POINTS = ("entry", "tip")
COLOURS = {"beads": "beads", "map": "map", "focal_point": "focal", "frame": "frame", "picks": "picks"}
MEANINGS = {
    "beads": "noise of the beads' measured centres",
    "map": "interpolation error of the image between and beyond the beads",
    "focal_point": "position of the X-ray source",
    "frame": "manufacturing errors of the frame: beads, plates, arms",
    "picks": "errors of the points picked in the images",
}


def tables(report: Report) -> dict[str, Any]:
    """Return the part of the template context that is not drawn."""
    return {
        "head": _head(report),
        "verdict": _verdict(report),
        "tiles": _tiles(report),
        "unnoticed": report.plan.unnoticed,
        "notes": list(_notes(report)),
        "points": _points(report),
        "wires": _wires(report),
        "first": report.spoken(report.images[0].name),
        "third": report.spoken(report.images[2].name) if len(report.images) > 2 else None,
        "comparison": _comparison(report),
        "drilled": drilled.section(report.drilled),
        "exposures": report.exposures,
        "exposures_note": NOTE,
        "checks": _checks(report),
    }


def _head(report: Report) -> list[tuple[str, str]]:
    """Return what the report is of, by name."""
    plan, frame = report.plan, report.frame
    sources = " and ".join(dict.fromkeys(image.seen.source for image in report.images if image.seen.source))
    named = f"{sources} (named by their content, so that no patient's name is passed on)"
    confirmed = [check.sentence for check in report.confirmed if check.passed]
    for image in report.images:
        if (mirrored := image.view.mirrored_display) is not None:
            confirmed.append(f"The {report.spoken(image.name)} display is {'' if mirrored else 'not '}mirrored.")
    return [
        ("Side", plan.side or "not stated"),
        ("Procedure", f"{plan.kind.name} ({plan.kind.fingerprint})"),
        ("Frame", frame.name + (f", serial {frame.serial}" if frame.serial else "")),
        ("Images", named if sources else "not named here"),
        ("Confirmed by a person", " ".join(confirmed) or "not known here: the app asks for it"),
    ]


def _verdict(report: Report) -> dict[str, Any]:
    verdict = report.verdict
    against = failed(verdict.checks)
    count = len(verdict.checks)
    sentence = {
        "go": f"All {count} checks passed. A person decides.",
        "no-go": f"{len(against)} of {count} checks stand against this plan:",
        "incomplete": f"{len(against)} of {count} checks could not be made because something is missing:",
    }[verdict.state]
    state, word, passed = verdict.state, verdict.state.upper(), count - len(against)
    of_wire = drilled.outcome(report.drilled) if verdict.go else None
    if of_wire is not None:
        sentence = f"{of_wire[2]} The plan: {word}. {sentence}"
        state, word, _, against = of_wire
    reasons = [_reason(check, report) for check in against]
    return {"state": state, "word": word, "sentence": sentence, "count": count, "passed": passed, "reasons": reasons}


def _reason(check: Check, report: Report) -> dict[str, str]:
    """Return a failed check, with the view that it belongs to."""
    view = f" ({report.spoken(check.view)} view)" if check.view else ""
    return {"name": f"{check.name}{view}", "sentence": check.sentence.removeprefix(f"{check.view}: ")}


def _tiles(report: Report) -> list[dict[str, str]]:
    path = report.plan.trajectory
    length = {"name": "Wire, entry to tip", "value": f"{path.length_mm:.1f} mm", "note": "along the planned path"}
    if not path.error_stated:
        failed = path.points.gap_failed.any()
        unknown = "the lines of sight miss each other" if failed else "a view states no covariance"
        points = [{"name": n, "value": "unknown", "note": unknown} for n in ("Entry point", "Tip", "Direction")]
        return [*points, length]
    limits = {check.code: check.limit for check in report.plan.verdict.checks}
    errors = (
        ("Entry point", CheckCode.ENTRY_ERROR, f"{path.entry_error_95_mm:.2f} mm", " mm"),
        ("Tip", CheckCode.END_ERROR, f"{path.end_error_95_mm:.2f} mm", " mm"),
        ("Direction", CheckCode.DIRECTION_ERROR, f"{np.rad2deg(path.direction_error_95_rad):.2f}°", "°"),
    )
    return [
        {"name": f"{name}, 95 % bound", "value": value, "note": f"at most {limits[code]:.2g}{unit}"}
        for name, code, value, unit in errors
    ] + [_own(report) or length]


def _own(report: Report) -> dict[str, str] | None:
    """Return the tile of the procedure's own metric, where it has one that was measured."""
    made = {check.code: check for check in report.plan.verdict.checks if check.figure is not None}
    if (check := made.get(CheckCode.TIP_APEX_DISTANCE)) is None:
        return None
    return {"name": "Tip-apex distance", "value": check.value_text, "note": check.limit_text}


# Errors that two images of one frame cannot reveal; docs/safety.md bounds each.
UNSEEN = (
    "The bounds hold if the frame matches its file within its tolerances. Two images cannot reveal a scale error of "
    "the file, a shifted plate, a pick that is wrong along its line of sight, or movement of the bone in the plane of "
    "both beams; a check shot reveals their combined effect."
)


def _notes(report: Report) -> Iterable[str]:
    yield f"{UNSEEN} The error of registering a robot is not included."
    if report.frame.tolerances is None and report.frame.covariance_mm2 is None:
        sd = report.frame.effective_tolerances
        yield (
            f"The frame file states no tolerances; defaults were used (one standard deviation: bead {sd.bead_mm:g} mm, "
            f"plate {sd.plate_mm:g} mm and {sd.plate_rad * 1e3:g} mrad, arm {sd.arm_mm:g} mm and {sd.arm_rad * 1e3:g} "
            "mrad). Measure your frame: the bounds are only as good as these tolerances."
        )
    yield from report.plan.sentences()
    for image in report.images:
        if image.view.mirrored:
            yield f"The {report.spoken(image.name)} image is a mirror image of the frame; it was used unchanged."


def _points(report: Report) -> list[dict[str, Any]]:
    """Return the rows of entry, tip and landmarks."""
    space, residual_px = report.plan.seen, np.linalg.norm(report.plan.residuals_px[-1], axis=1)
    landmarks = (name or f"landmark {k}" for k, name in enumerate(report.plan.landmark_names, 1))
    names = [*POINTS, *landmarks]
    rows = []
    for i, name in enumerate(names):
        sds = np.sqrt(np.diag(space.covariance_mm2[i])) if space.error_stated[i] else (None,) * 3
        tested = space.gap_tested[i]
        sigma = f" ({space.gap_sigma[i]:.1f} σ)" if tested and space.gap_sigma is not None else ""
        rows.append(
            {
                "name": name,
                "xyz": list(zip(space.xyz_mm[i], sds, strict=True)),
                "gap": f"{space.gap_mm[i]:.2f}{sigma}" if tested else "not tested",
                "how": "free" if tested else "snapped to the image-matching curve",
                "residual": "not picked" if np.isnan(residual_px[i]) else f"{residual_px[i]:.2f}",
            }
        )
    return rows


def _wires(report: Report) -> dict[str, Any] | None:
    """Return the wires that were planned together, in the order of drilling, and their relations."""
    made = report.wires
    if made is None:
        return None
    rows = []
    for key, plan in made.plans.items():
        path = plan.trajectory
        errors = (path.entry_error_95_mm, path.end_error_95_mm) if path.error_stated else (None, None)
        rows.append(
            {
                "name": plan.kind.wire.name,
                "this": key == report.plan.kind.wire.key,
                "verdict": plan.verdict.state.upper(),
                "points": list(zip(path.points.xyz_mm, errors, strict=True)),
                "length": path.length_mm,
                "measured": _measured(report.measured.get(key)),
            }
        )
    names = {wire.key: wire.name for wire in made.procedure.wires}
    measured = judge_measured(made, report.measured, report.plan.side) if report.measured else Verdict(())
    return {
        "word": made.verdict.state.upper(),
        "rows": rows,
        "others": [f"{names[key]}: in the bone already" for key in made.placed]
        + [f"{names[key]}: not planned" for key in made.missing],
        "relations": [_check(check) for check in made.relations]
        + [_check(check) | {"name": f"{check.name}, as measured"} for check in measured.checks],
    }


def _measured(shot: CheckShot | None) -> str:
    """Return what the check shot of a wire found."""
    if shot is None:
        return "not measured"
    deg = np.rad2deg(shot.angle_rad)
    state = "passed" if shot.passed else "FAILED"
    return f"{state}: entry {shot.entry_deviation_mm:.2f} mm, tip {shot.tip_deviation_mm:.2f} mm, {deg:.2f}°"


def bars(report: Report) -> list[Bar]:
    """Return the error budget; empty if the error is unknown."""
    if not report.plan.trajectory.error_stated:
        return []
    rms = report.plan.trajectory.budget_rms()
    return [
        Bar("entry", "mm", {source: v["entry_mm"] for source, v in rms.items()}),
        Bar("tip", "mm", {source: v["end_mm"] for source, v in rms.items()}),
        Bar("direction", "°", {source: float(np.rad2deg(v["direction_rad"])) for source, v in rms.items()}),
    ]


def budget_rows(report: Report) -> list[dict[str, Any]]:
    """Return the error budget as rows, one per source."""
    everything = bars(report)
    return [
        {
            "name": source.replace("_", " "),
            "colour": COLOURS[source],
            "cells": [bar.rms[source] for bar in everything],
            "meaning": meaning,
        }
        for source, meaning in MEANINGS.items()
    ]


def _comparison(report: Report) -> dict[str, Any] | None:
    if not report.compared:
        return None
    groups = list(dict.fromkeys(compared.picks for compared in report.compared))
    return {
        "sentence": "The images are the twin's, so the true wire is known.",
        "tables": [
            {
                "title": picks.capitalize(),
                "rows": [_row(compared, report) for compared in report.compared if compared.picks == picks],
            }
            for picks in groups
        ],
        "footnote": "An error lies within its 95 % bound 95 times in a hundred, not always. Every row contains the "
        "errors of the frame: no method can estimate them from one pair of images; only the bounds account for them.",
    }


def _row(compared: Compared | Refused, report: Report) -> dict[str, Any]:
    if isinstance(compared, Refused):
        return {"method": compared.method, "chosen": False, "refused": compared.reason}
    bounds, within = compared.bounds_95, compared.within_bounds
    values = [f"{v:.3f}" for v in compared.errors] + (["-"] * 3 if bounds is None else [f"{v:.3f}" for v in bounds])
    return {
        "method": compared.method,
        "chosen": compared.trajectory is report.plan.trajectory,
        "refused": None,
        "cells": values,
        "inside": None if within is None else within == len(compared.errors),
        "inside_word": "not stated" if within is None else f"{within} of {len(compared.errors)}",
    }


def _checks(report: Report) -> list[dict[str, Any]]:
    """Return the checks by subject: each view after calibration, the plan, the confirmations, the drilling."""
    views = {image.name: image.view.checks for image in report.images}
    blocks = [(f"Calibration of the {report.spoken(name)} view", checks) for name, checks in views.items()]
    blocks.append(("The plan", tuple(c for c in report.plan.verdict.checks if not c.view)))
    blocks.append(("What a person confirmed", tuple(report.confirmed)))
    blocks += drilled.checks(report.drilled)
    return [{"title": title, "rows": [_check(c) for c in checks]} for title, checks in blocks if checks]


def _check(check: Check) -> dict[str, Any]:
    return {
        "name": check.name,
        "value": check.value_text,
        "limit": check.limit_text,
        "passed": check.passed,
        "sentence": check.sentence,
    }
