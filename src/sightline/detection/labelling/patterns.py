"""What labelling needs of a frame: each plate as a flat pattern of large and small fiducials."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

from sightline.frame import Frame, Plate
from sightline.geometry.planes import Plane

NEIGHBOUR = 1.2  # fiducials nearer than this many pitches are neighbours: not the diagonal of a square [ours]


@dataclass(frozen=True, eq=False)
class Pattern:
    """One plate of one view: `xy_mm` (N, 2) in `plane`'s axes, with the plate's centre as the origin.

    `neighbours` (M, 2): ordered pairs of neighbours; `pitch_mm`: their median distance.
    """

    view: str
    role: str
    ids: tuple[str, ...]
    plane: Plane
    xyz_mm: np.ndarray
    xy_mm: np.ndarray
    diameter_mm: np.ndarray
    datum: np.ndarray
    washer: np.ndarray
    neighbours: np.ndarray
    pitch_mm: float

    @property
    def datums(self) -> np.ndarray:
        """Rows of the datum markers."""
        return np.flatnonzero(self.datum)


def _pattern(view: str, role: str, plate: Plate) -> Pattern:
    xy = plate.plane.to_plane(plate.xyz_mm)
    tree = KDTree(xy)
    pitch = float(np.median(tree.query(xy, k=2)[0][:, 1]))
    pairs = tree.query_pairs(NEIGHBOUR * pitch, output_type="ndarray")
    return Pattern(
        view=view,
        role=role,
        ids=plate.ids,
        plane=plate.plane,
        xyz_mm=plate.xyz_mm,
        xy_mm=np.ascontiguousarray(xy),
        diameter_mm=np.array([f.diameter_mm for f in plate.fiducials]),
        datum=np.asarray(plate.is_datum),
        washer=np.array([f.shape == "washer" for f in plate.fiducials]),
        neighbours=np.concatenate([pairs, pairs[:, ::-1]]),
        pitch_mm=pitch,
    )


@lru_cache(maxsize=8)
def patterns(frame: Frame) -> tuple[Pattern, ...]:
    """The plates of all views, in each view XRII before source."""
    return tuple(
        _pattern(name, role, plate)
        for name, view in frame.views.items()
        for role, plate in (("xrii", view.xrii), ("source", view.source))
    )
