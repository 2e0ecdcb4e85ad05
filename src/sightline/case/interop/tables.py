"""A plan as CSV: one line per point and coordinate frame, with errors and verdict."""

import csv
import io
from collections.abc import Iterator

import numpy as np

from sightline.case.interop.itk import R_lps_cfcs
from sightline.case.interop.plan_file import PlanFile

COLUMNS = (
    "point",
    "coordinates",
    "x_mm",
    "y_mm",
    "z_mm",
    *(f"s{a}{b}_mm2" for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")),
    "error_95_mm",
    "plan",
)
_UPPER = np.triu_indices(3)


def write(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return `trajectory.csv`: in CFCS, and in patient LPS too if the side is given. Unknown errors are empty cells."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_rows(plan, "CFCS", np.eye(3)))
    if side is not None:
        writer.writerows(_rows(plan, "LPS", R_lps_cfcs(side)))
    return {"trajectory.csv": out.getvalue().encode()}


def _rows(plan: PlanFile, frame: str, rotation: np.ndarray) -> Iterator[list[str]]:
    covariance, errors = plan.covariance_mm2, plan.errors_95_mm
    for k, name in enumerate(("entry", "end")):
        spread, error = [""] * 6, ""
        if covariance is not None and errors is not None:
            block = rotation @ covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ rotation.T
            spread, error = [repr(float(x)) for x in block[_UPPER]], repr(errors[k])
        yield [name, frame, *_place(rotation @ plan.points_mm[k]), *spread, error, plan.verdict]
    for k, landmark in enumerate(plan.document.landmarks):
        yield [f"landmark {k + 1}", frame, *_place(rotation @ np.array(landmark.xyz_mm)), *[""] * 7, plan.verdict]


def _place(xyz_mm: np.ndarray) -> list[str]:
    return [repr(float(x) + 0.0) for x in xyz_mm]
