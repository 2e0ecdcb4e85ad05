"""Plane maps on perforated plates: a coarse lattice of holes is known, the others are predicted.

Real images of an ARCADIS mobile C-arm, in `../shared/data/arcadis` next to the repository. The plate's pitch is not
published: a nominal one gives the size of a pixel, and results are in pixels.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

import sightline as sl
from benchmarks.rows import Row
from sightline.studies.measures import walk
from sightline.studies.methods import Fit, Predict, local_weighted_mean, thin_plate_spline

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "arcadis"
PLATES = ("plate_0", "plate_orbit30", "plate_orbit60")
PITCH_MM = 3.2  # nominal: 3,550 holes in a hexagonal lattice over a round field of 215 mm
STEPS = (4, 6, 8, 10)  # every 4th row and column, ...: about 220, 98, 55 and 37 controls
EXTRA_NOISE_PX = (0.0, 0.3)
WITHIN = 1.04


@dataclass(frozen=True, eq=False)
class Plate:
    """Holes of one image: pixels (N, 2), lattice indices (N, 2), and their ideal places on the plate (N, 2), mm."""

    uv_px: np.ndarray
    index: np.ndarray

    @property
    def xy_mm(self) -> np.ndarray:
        """Ideal places (N, 2), mm; the lattice axes are 60 degrees apart."""
        return PITCH_MM * self.index @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])

    @staticmethod
    def read(name: str) -> "Plate":
        """Return holes found by `sl.detect`, indexed by growing a lattice from the middle."""
        found = sl.detect(sl.read_image(FOLDER / f"{name}.dcm"))
        return grow(found.uv_px[np.array(found.kind) == "hole"])


def grow(uv_px: np.ndarray) -> Plate:
    """Return a hexagonal lattice grown from neighbour to neighbour; points off the lattice are left out."""
    tree = KDTree(uv_px)
    start = int(tree.query(np.median(uv_px, axis=0))[1])
    around = uv_px[np.asarray(tree.query(uv_px[start], k=7)[1])[1:]] - uv_px[start]
    around = around[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
    axes = np.array([(around[0] - around[3]) / 2, (around[1] - around[4]) / 2])
    place = walk(uv_px, tree, start, axes)
    return Plate(uv_px[list(place.values())], np.array(list(place)))


def smooth(uv: np.ndarray, xy: np.ndarray) -> Predict:
    """Fit ours; the noise of the holes is estimated."""
    return sl.fit_map(uv, xy, "smooth", noise_px=None).to_plane


def polynomial(degree: int) -> Fit:
    """Return a least-squares fit of ours."""

    def fit(uv: np.ndarray, xy: np.ndarray) -> Predict:
        try:
            return sl.fit_map(uv, xy, "polynomial", degree=degree).to_plane
        except sl.SightlineError:  # more coefficients than controls
            return lambda at: np.full_like(at, np.inf)

    return fit


def triangles(uv: np.ndarray, xy: np.ndarray) -> Predict:
    """Fit the paper's method, as we implement it."""
    return sl.fit_map(uv, xy, "localized").to_plane


METHODS: dict[str, Fit] = {
    "smooth": smooth,
    "polynomial 3": polynomial(3),
    "polynomial 5": polynomial(5),
    "polynomial 7": polynomial(7),
    "triangles": triangles,
    "local weighted mean": local_weighted_mean,
    "thin-plate spline": thin_plate_spline,
}


def errors_px(plate: Plate, step: int, offset: tuple[int, int], noise_px: np.ndarray) -> tuple[int, dict[str, float]]:
    """Return the number of controls, and each method's rms error (px, per point) at all other enclosed holes."""
    control = ((plate.index - np.array(offset)) % step == 0).all(axis=1)
    uv, xy = plate.uv_px[control] + noise_px[control], plate.xy_mm[control]
    inside = sl.fit_map(uv, xy, "localized").containing_triangle(plate.uv_px) >= 0  # type: ignore[attr-defined]
    others = inside & ~control
    per_px = np.sqrt(abs(np.linalg.det(np.linalg.lstsq(uv - uv.mean(0), xy - xy.mean(0), rcond=None)[0])))
    out = {}
    for name, method in METHODS.items():
        miss = (method(uv, xy)(plate.uv_px[others]) - plate.xy_mm[others]) / per_px
        out[name] = float(np.sqrt((miss**2).sum(axis=1).mean()))
    return int(control.sum()), out


def run(quick: bool) -> list[Row]:
    """Return a row for each spacing and noise: smooth against the best of the others."""
    if not FOLDER.exists():
        return [
            Row("plates", "all", "skipped: the ARCADIS images are not beside the repository (../shared/data/arcadis)")
        ]
    plates = [Plate.read(name) for name in (PLATES[:1] if quick else PLATES)]
    rows = [Row("plates", "holes numbered", ", ".join(str(len(p.uv_px)) for p in plates), ">= 3500 each")]
    ours, best = [], []
    for noise in EXTRA_NOISE_PX:
        for step in STEPS:
            rng = np.random.default_rng(step)
            offsets = [(0, 0), (step // 2, step // 2), (0, step // 2), (step // 2, 0)][: 1 if quick else 4]
            tries = [
                errors_px(plate, step, offset, noise * rng.standard_normal(plate.uv_px.shape))
                for plate in plates
                for offset in offsets
            ]
            rms = {m: float(np.sqrt(np.mean([t[1][m] ** 2 for t in tries]))) for m in METHODS}
            peer = min((m for m in METHODS if m != "smooth"), key=lambda m: rms[m])
            ours.append(rms["smooth"])
            best.append(rms[peer])
            rows.append(
                Row(
                    "plates",
                    f"{np.mean([t[0] for t in tries]):.0f} controls, {noise} px added",
                    f"{rms['smooth']:.3f} px",
                    f"<= {WITHIN} of the best other",
                    f"{peer} {rms[peer]:.3f}; " + ", ".join(f"{m} {rms[m]:.2f}" for m in METHODS if m != "smooth"),
                    rms["smooth"] <= WITHIN * rms[peer],
                )
            )
    mean, others = float(np.mean(ours)), float(np.mean(best))
    rows.append(
        Row("plates", "mean of columns", f"{mean:.3f} px", "< best of the others", f"{others:.3f}", mean < others)
    )
    return rows
