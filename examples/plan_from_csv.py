"""Plan a wire from beads labelled by other software: `python plan_from_csv.py observations.csv`.

The schema is in docs/observations-csv.md; `sightline demo` writes such a file to out/demo/.
"""

import sys

import numpy as np

import sightline as sl
from sightline.common.checks import failed
from sightline.detection.csv_files import read_observations
from sightline.planning import kind, matching_curve, plan


def main(path: str) -> None:
    """Print the trajectory between two picked points, with its bounds and its error budget."""
    frame = sl.Frame.load("gamma")
    seen = read_observations(path)
    views = [sl.calibrate(seen[name], frame) for name in ("pa", "lateral")]
    entry_px, end_px = (pair_of_picks(views, uv) for uv in ([560.0, 580.0], [440.0, 430.0]))
    made = plan(views, entry_px, end_px, snapped=True, procedure=kind("free-wire"))
    wire = made.trajectory
    print("GO" if made.verdict.go else "NO-GO")
    for check in failed(made.verdict.checks):  # snapped picks alone do not show whether the patient moved
        print(f"  {check.name}: {check.sentence}")
    print("entry, mm:", wire.entry_mm.round(2), "within", round(wire.entry_error_95_mm, 2), "(95 %)")
    print("tip, mm:  ", wire.end_mm.round(2), "within", round(wire.end_error_95_mm, 2), "(95 %)")
    for source, rms in wire.budget_rms().items():
        print(f"{source:12s} {rms['end_mm']:.3f} mm rms at the tip")


def pair_of_picks(views: list[sl.CalibratedView], pa_px: list[float]) -> np.ndarray:
    """Return a PA pick and its point in the lateral image, 300 mm along the line of sight."""
    curve = matching_curve(views[0], np.array(pa_px), views[1])
    return np.array([pa_px, curve.uv_px[np.argmin(np.abs(curve.depth_mm - 300.0))]])


if __name__ == "__main__":
    main(sys.argv[1])
