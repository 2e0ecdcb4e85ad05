"""A bone as a volume of attenuation beyond that of soft tissue, at several resolutions."""

from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sightline.errors import UnusableInputError
from sightline.imaging.volumes.beam import TABLE_PER_CM
from sightline.imaging.volumes.ct import CtScan, shares_of_hu
from sightline.imaging.volumes.volume import Volume

BONE_HU = 100.0  # [ours] above soft tissue and its noise; cancellous bone has 100 to 300
DENSE_HU = 400  # a fifth of dense bone: every bone's cortex has more, noise and tendons less [ours]
_COARSE_MM = 4.0
_EDGE_MM = 3.0  # [ours] kept around bone
_CUT = 0.2  # [ours] share of bone above which a face of the volume cuts it
_EXCESS_PER_MM = (TABLE_PER_CM["bone"][1] - TABLE_PER_CM["tissue"][1]) / 10


@dataclass(frozen=True, eq=False)
class ScannedBone:
    """The bone of a CT or mesh, in its own coordinates: `volume` of attenuation, 1/mm, beyond soft tissue's."""

    volume: Volume

    @staticmethod
    def of_ct(scan: CtScan) -> "ScannedBone":
        """Return the bone of a scan that was cropped to it. Raises UnusableInputError without bone."""
        scan = _cropped(scan)
        share = np.where(scan.hu > BONE_HU, shares_of_hu(scan.hu)[1], np.float32(0.0))
        return ScannedBone(Volume(share * _EXCESS_PER_MM, scan.origin_mm, scan.voxel_mm, scan.axes))

    @cached_property
    def sha256(self) -> str:
        """Hash of which voxels hold bone, and of where they lie, to 1e-3 mm: the same on every machine."""
        volume = self.volume
        grid = np.concatenate([volume.origin_mm, volume.voxel_mm, volume.axes.ravel()]).round(3) + 0.0
        return sha256(
            repr((volume.values.shape, grid.tolist())).encode() + np.packbits(volume.values > 0).tobytes()
        ).hexdigest()

    @cached_property
    def centre_mm(self) -> np.ndarray:
        """(3,) centre of mass of the attenuation."""
        return self._moments[0]

    @cached_property
    def spread_mm(self) -> np.ndarray:
        """(3, 3): rows are the principal axes, as long as the standard deviation of the attenuation along them."""
        return self._moments[1]

    @cached_property
    def points_mm(self) -> np.ndarray:
        """(N, 3) middles of coarse voxels that hold bone."""
        return self._dense[0]

    @cached_property
    def _dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles of coarse voxels that hold bone (N, 3), and their attenuation (N,)."""
        coarse = self.at(_COARSE_MM)
        at = np.argwhere(coarse.values > 0)
        return coarse.origin_mm + (coarse.voxel_mm * at) @ coarse.axes, coarse.values[tuple(at.T)].astype(np.float64)

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        xyz, weight = self._dense
        centre = weight @ xyz / weight.sum()
        values, vectors = np.linalg.eigh(np.cov(xyz.T, aweights=weight, bias=True))
        return centre, vectors.T * np.sqrt(values)[:, None]

    @cached_property
    def corners_mm(self) -> np.ndarray:
        """(8, 3) corners of the volume."""
        steps = np.stack(np.meshgrid(*[[0, n - 1] for n in self.volume.values.shape], indexing="ij"), axis=-1)
        return self.volume.origin_mm + (self.volume.voxel_mm * steps.reshape(-1, 3)) @ self.volume.axes

    @cached_property
    def cut_mm(self) -> np.ndarray:
        """(N, 3) points on the volume's faces where bone goes on beyond them."""
        coarse = self.at(_COARSE_MM)
        inner = np.zeros(coarse.values.shape, dtype=bool)
        inner[1:-1, 1:-1, 1:-1] = True
        at = np.argwhere(~inner & (coarse.values > _CUT * _EXCESS_PER_MM))
        return coarse.origin_mm + (coarse.voxel_mm * at) @ coarse.axes

    def at(self, spacing_mm: float) -> Volume:
        """Return the volume with voxels of at least `spacing_mm`, smoothed by as much."""
        if spacing_mm not in self._levels:
            self._levels[spacing_mm] = _resampled(self.volume, spacing_mm)
        return self._levels[spacing_mm]

    @cached_property
    def _levels(self) -> dict[float, Volume]:
        return {}


def _cropped(scan: CtScan) -> CtScan:
    """Return the part of a scan that holds bone, with a margin where there is one. Raises UnusableInputError."""
    dense = scan.hu > DENSE_HU
    if not dense.any():
        raise UnusableInputError(
            f"the CT holds no bone (no value above {DENSE_HU} HU); give a CT in Hounsfield units, cropped to the bone"
        )
    low, high = [], []
    for a in range(3):
        within = np.flatnonzero(dense.any(axis=tuple({0, 1, 2} - {a})))
        margin = int(np.ceil(_EDGE_MM / scan.voxel_mm[a]))
        low.append(max(int(within[0]) - margin, 0))
        high.append(min(int(within[-1]) + margin + 1, dense.shape[a]))
    part = scan.hu[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    return replace(scan, hu=part, origin_mm=scan.origin_mm + (scan.voxel_mm * low) @ scan.axes)


def _resampled(volume: Volume, spacing_mm: float) -> Volume:
    spacing = np.maximum(volume.voxel_mm, spacing_mm)
    if (spacing == volume.voxel_mm).all():
        return volume
    # The s.d. by which a voxel of the new size is wider than the old one, each a box.
    smooth = gaussian_filter(volume.values, np.sqrt((spacing / volume.voxel_mm) ** 2 - 1) / 12**0.5, mode="nearest")
    extent = volume.voxel_mm * (np.array(volume.values.shape) - 1)
    counts = np.maximum(np.floor(extent / spacing).astype(int) + 1, 2)
    first = (extent - spacing * (counts - 1)) / 2
    at = [(first[a] + spacing[a] * np.arange(counts[a])) / volume.voxel_mm[a] for a in range(3)]
    values = map_coordinates(smooth, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
    return replace(volume, values=values, origin_mm=volume.origin_mm + first @ volume.axes, voxel_mm=spacing)
