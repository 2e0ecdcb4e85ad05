"""The figures of a report as its template wants them: words and rounded numbers."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sightline.case.report import drilled, exposures
from sightline.case.report.comparison import Compared, Refused
from sightline.case.report.content import Report
from sightline.case.report.figures.budget import Bar
from sightline.case.views import NAMES, spoken
from sightline.checks import Check, failed

POINTS = ("entry", "tip")
COLOURS = {"beads": "beads", "map": "map", "focal_point": "focal", "frame": "frame", "picks": "picks"}
MEANINGS = {
    "beads": "noise of the beads' measured centres",
    "map": "what the image does between and beyond the beads",
    "focal_point": "where the X-ray source stood",
    "frame": "how exactly the frame was made: beads, plates, arms",
    "picks": "how exactly the points were picked in the images",
}


def tables(report: Report) -> dict[str, Any]:
    """Everything of the template's context that is not a picture."""
    return {
        "subtitle": _subtitle(report),
        "verdict": _verdict(report),
        "tiles": _tiles(report),
        "notes": list(_notes(report)),
        "points": _points(report),
        "comparison": _comparison(report),
        "drilled": drilled.section(report.drilled),
        "exposures": report.exposures,
        "exposures_note": exposures.NOTE,
        "checks": _checks(report),
    }


def _subtitle(report: Report) -> str:
    serial = f", serial {report.frame.serial}" if report.frame.serial else ""
    pa, lateral = report.images
    sources = pa.seen.source if pa.seen.source == lateral.seen.source else f"{pa.seen.source} and {lateral.seen.source}"
    return f"Frame {report.frame.name}{serial}; {sources}; calibrated with the method {pa.view.method}"


def _verdict(report: Report) -> dict[str, Any]:
    verdict = report.plan.verdict
    against = failed(verdict.checks)
    count = len(verdict.checks)
    sentence = {
        "go": f"All {count} checks passed. A person decides.",
        "no-go": f"{len(against)} of {count} checks stand against this plan:",
        "incomplete": f"{len(against)} of {count} checks could not be made, since something is missing:",
    }[verdict.state]
    return {
        "state": verdict.state,
        "word": verdict.state.upper(),
        "sentence": sentence,
        "reasons": [_reason(c, report) for c in against],
    }


def _reason(check: Check, report: Report) -> dict[str, str]:
    """A failed check, with the view that it is about."""
    about = [spoken(image.name) for image in report.images if any(check is one for one in image.view.checks)]
    return {"name": f"{check.name}{f' ({about[0]} view)' if about else ''}", "sentence": check.sentence}


def _tiles(report: Report) -> list[dict[str, str]]:
    path = report.plan.trajectory
    length = {"name": "Wire, entry to tip", "figure": f"{path.length_mm:.1f} mm", "note": "along the planned path"}
    if not path.error_stated:
        failed = path.points.gap_failed.any()
        unknown = "the lines of sight miss each other" if failed else "a view states no covariance"
        return [{"name": n, "figure": "unknown", "note": unknown} for n in ("Entry point", "Tip", "Direction")] + [
            length
        ]
    limits = {check.name: check.limit for check in report.plan.verdict.checks}
    figures = (
        ("Entry point", "entry error", f"{path.entry_error_95_mm:.2f} mm", " mm"),
        ("Tip", "end error", f"{path.end_error_95_mm:.2f} mm", " mm"),
        ("Direction", "direction error", f"{np.rad2deg(path.direction_error_95_rad):.2f}°", "°"),
    )
    return [
        {"name": f"{name}, 95 % bound", "figure": figure, "note": f"limit {limits[check]:.2g}{unit}"}
        for name, check, figure, unit in figures
    ] + [length]


# What no two images of one frame can show; docs/safety.md bounds each.
UNSEEN = (
    "The bounds hold if the frame is what its file says, within its tolerances. Two images cannot show a file that is "
    "wrong by one scale, a plate that has shifted, one pick that is wrong along its line of sight, or movement of the "
    "bone in the plane of both beams; a check shot shows what they come to."
)


def _notes(report: Report) -> Iterable[str]:
    yield UNSEEN
    yield (
        "All coordinates are in CFCS, those of the calibration frame: no robot is known here, so the error of "
        "registering one is not in these figures."
    )
    if report.frame.tolerances is None and report.frame.covariance_mm2 is None:
        sd = report.frame.effective_tolerances
        yield (
            f"The frame file states no tolerances; defaults were used (one standard deviation: bead {sd.bead_mm:g} mm, "
            f"plate {sd.plate_mm:g} mm and {sd.plate_rad * 1e3:g} mrad, arm {sd.arm_mm:g} mm and {sd.arm_rad * 1e3:g} "
            "mrad). Measure your frame: the bounds are only as true as these."
        )
    yield " ".join(report.plan.along_sentences())
    for image in report.images:
        if image.view.mirrored:
            yield f"The {spoken(image.name)} image is a mirror image of the frame; it was used as it is."


def _points(report: Report) -> list[dict[str, Any]]:
    """Entry, tip and landmarks."""
    space = report.plan.seen
    names = [*POINTS, *(f"landmark {k + 1}" for k in range(len(space.xyz_mm) - len(POINTS)))]
    out = []
    for i, name in enumerate(names):
        sds = np.sqrt(np.diag(space.covariance_mm2[i])) if space.error_stated[i] else (None,) * 3
        tested = space.gap_tested[i]
        sigma = f" ({space.gap_sigma[i]:.1f} σ)" if tested and space.gap_sigma is not None else ""
        out.append(
            {
                "name": name,
                "xyz": list(zip(space.xyz_mm[i], sds, strict=True)),
                "gap": f"{space.gap_mm[i]:.2f}{sigma}" if tested else "not tested",
                "how": "free" if tested else "snapped to the image-matching curve",
            }
        )
    return out


def bars(report: Report) -> list[Bar]:
    """The error budget; empty where the error is unknown."""
    if not report.plan.trajectory.error_stated:
        return []
    rms = report.plan.trajectory.budget_rms()
    return [
        Bar("entry", "mm", {source: v["entry_mm"] for source, v in rms.items()}),
        Bar("tip", "mm", {source: v["end_mm"] for source, v in rms.items()}),
        Bar("direction", "°", {source: float(np.rad2deg(v["direction_rad"])) for source, v in rms.items()}),
    ]


def budget_rows(report: Report) -> list[dict[str, Any]]:
    """The same as rows, one for each source."""
    everything = bars(report)
    return [
        {
            "name": source.replace("_", " "),
            "colour": COLOURS[source],
            "figures": [bar.rms[source] for bar in everything],
            "meaning": meaning,
        }
        for source, meaning in MEANINGS.items()
    ]


def _comparison(report: Report) -> dict[str, Any] | None:
    if not report.compared:
        return None
    groups = list(dict.fromkeys(one.picks for one in report.compared))
    return {
        "sentence": "The images are the twin's, so the true wire is known.",
        "tables": [
            {"title": picks.capitalize(), "rows": [_row(one, report) for one in report.compared if one.picks == picks]}
            for picks in groups
        ],
        "footnote": "An error lies within its 95 % bound 95 times in a hundred, not always. The frame's own errors are "
        "in every row: from one pair of images no method can see them, so they are only in the bounds.",
    }


def _row(one: Compared | Refused, report: Report) -> dict[str, Any]:
    if isinstance(one, Refused):
        return {"method": one.method, "chosen": False, "refused": one.reason}
    bounds, kept = one.bounds_95, one.kept
    figures = [f"{v:.3f}" for v in one.figures] + (["-"] * 3 if bounds is None else [f"{v:.3f}" for v in bounds])
    return {
        "method": one.method,
        "chosen": one.trajectory is report.plan.trajectory,
        "refused": None,
        "figures": figures,
        "inside": None if kept is None else kept == len(one.figures),
        "inside_word": "not stated" if kept is None else f"{kept} of {len(one.figures)}",
    }


def _checks(report: Report) -> list[dict[str, Any]]:
    """By what was checked: each view as its calibration left it, then the plan."""
    views = {name: image.view.checks for name, image in zip(NAMES, report.images, strict=True)}
    of_views = [check for checks in views.values() for check in checks]
    blocks = [(f"Calibration of the {spoken(name)} view", checks) for name, checks in views.items()]
    blocks.append(("The plan", tuple(c for c in report.plan.verdict.checks if c not in of_views)))
    blocks += drilled.checks(report.drilled)
    return [{"title": title, "rows": [_check(c) for c in checks]} for title, checks in blocks if checks]


def _check(check: Check) -> dict[str, Any]:
    shown = ["not measured" if v is None else f"{v:.3g} {check.unit}".strip() for v in (check.figure, check.limit)]
    return {
        "name": check.name,
        "figure": shown[0],
        "limit": shown[1] if check.limit is not None else "",
        "passed": check.passed,
        "sentence": check.sentence,
    }
