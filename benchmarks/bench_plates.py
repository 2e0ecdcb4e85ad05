"""Plane maps on perforated plates: a coarse lattice of holes is known, the others are predicted.

Real images of an ARCADIS mobile C-arm, in `../shared/data/arcadis` next to the repository. The plate's pitch is not
published: a nominal one gives the size of a pixel, and results are in pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import KDTree

import sightline as sl
from benchmarks.harness import ARCADIS, Rows, rms
from sightline.detection.lattice import walk
from sightline.studies.methods import Predict, local_weighted_mean, thin_plate_spline

PLATES = ("plate_0", "plate_orbit30", "plate_orbit60")
PITCH_MM = 3.2  # nominal: 3,550 holes in a hexagonal lattice over a round field of 215 mm
STEPS = (4, 6, 8, 10)  # every 4th row and column, ...: about 220, 98, 55 and 37 controls
EXTRA_NOISE_PX = (0.0, 0.3)
WITHIN = 1.04  # of the best other


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
        """Return holes found by `sl.detect`, on a hexagonal lattice grown from the middle, from neighbour to neighbour;
        points off the lattice are left out."""
        beads = sl.detect(sl.read_image(ARCADIS / f"{name}.dcm"))
        uv_px = beads.uv_px[np.array(beads.kind) == "hole"]
        tree = KDTree(uv_px)
        start = int(tree.query(np.median(uv_px, axis=0))[1])
        around = uv_px[np.asarray(tree.query(uv_px[start], k=7)[1])[1:]] - uv_px[start]
        around = around[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
        place = walk(uv_px, tree, start, np.array([(around[0] - around[3]) / 2, (around[1] - around[4]) / 2]))
        return Plate(uv_px[list(place.values())], np.array(list(place)))


def ours(method: str, uv: np.ndarray, xy: np.ndarray, **options: Any) -> Predict:
    """Fit a map of this package; infinite where there are more coefficients than controls."""
    try:
        return sl.fit_map(uv, xy, method, **options).to_plane
    except sl.SightlineError:
        return lambda at: np.full_like(at, np.inf)


METHODS: dict[str, Callable[[np.ndarray, np.ndarray], Predict]] = {
    "smooth": partial(ours, "smooth", noise_px=None),
    **{f"polynomial {degree}": partial(ours, "polynomial", degree=degree) for degree in (3, 5, 7)},
    "triangles": partial(ours, "localized"),  # the paper's method, as we implement it
    "local weighted mean": local_weighted_mean,
    "thin-plate spline": thin_plate_spline,
}


def errors_px(plate: Plate, step: int, offset: tuple[int, int], noise_px: np.ndarray) -> dict[str, float]:
    """Return each method's rms error (px, per point) at all other enclosed holes, and the number of "controls"."""
    control = ((plate.index - np.array(offset)) % step == 0).all(axis=1)
    uv, xy = plate.uv_px[control] + noise_px[control], plate.xy_mm[control]
    inside = sl.fit_map(uv, xy, "localized").containing_triangle(plate.uv_px) >= 0  # type: ignore[attr-defined]
    others = inside & ~control
    per_px = np.sqrt(abs(np.linalg.det(np.linalg.lstsq(uv - uv.mean(0), xy - xy.mean(0), rcond=None)[0])))
    errors = {"controls": float(control.sum())}
    for name, method in METHODS.items():
        errors[name] = rms(np.linalg.norm(method(uv, xy)(plate.uv_px[others]) - plate.xy_mm[others], axis=1) / per_px)
    return errors


def run(quick: bool) -> Rows:
    """Return a row for each spacing and noise: smooth against the best of the others."""
    rows = Rows("plates")
    if not ARCADIS.is_dir():
        rows.add("all", "skipped: the ARCADIS images are not beside the repository (../shared/data/arcadis)")
        return rows
    plates, own, best = [Plate.read(name) for name in (PLATES[:1] if quick else PLATES)], [], []
    rows.number("holes numbered", [len(plate.uv_px) for plate in plates], ",", least=3500)
    for noise in EXTRA_NOISE_PX:
        for step in STEPS:
            rng, half = np.random.default_rng(step), step // 2
            offsets = [(0, 0), (half, half), (0, half), (half, 0)][: 1 if quick else 4]
            tries = [
                errors_px(plate, step, offset, noise * rng.standard_normal(plate.uv_px.shape))
                for plate in plates
                for offset in offsets
            ]
            error = {name: rms([each[name] for each in tries]) for name in METHODS}
            smooth = error.pop("smooth")
            own.append(smooth)
            best.append(min(error.values()))
            name = f"{np.mean([each['controls'] for each in tries]):.0f} controls, {noise} px added"
            peer = ", ".join(f"{method} {value:.3f}" for method, value in error.items())
            rows.number(name, smooth, ".3f", "px", most=round(WITHIN * best[-1], 4), peer=peer)
    mean, others = np.mean(own), np.mean(best)
    name, peer = (
        f"smooth against the best of six peers, {len(own)} columns (ARCADIS)",
        f"best of six others {others:.3f} px",
    )
    rows.add(name, f"mean {mean:.3f} px", "better in the mean", mean < others, peer=peer)
    rows.insert(0, rows.pop())  # the page shows the first
    return rows
