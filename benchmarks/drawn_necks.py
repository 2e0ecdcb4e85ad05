"""Where a person who sees a neck's true outline clicks on its borders."""

import numpy as np

from sightline.errors import SetUpError
from sightline.twin.anatomy.femur import Femur

STATIONS = np.arange(0.25, 0.8, 0.006)  # along the neck, of its length from the head's centre
DEPTHS_MM = np.arange(-14.0, 14.5, 2.0)  # along the beam, of the places where a line of sight may touch the bone
BESIDE_HEAD = (1.05, 1.10)  # of the first click, radii from the head's centre: where the neck leaves the head [ours]
PAST_MM = (3.5, 6.5)  # of the second click, along the border from the neck's narrowest place [ours]
HIDDEN = (0.36, 0.56)  # stations of clicks in an image that does not show a neck
ACROSS = (
    0.5  # cosine of the angle of neck and beam; an image whose beam is nearer to the neck shows head and trochanter
)


def neck_clicks(femur: Femur, source_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return points (2, 2, 3) on lines of sight of both borders, two on each, seen from the source (3,); anatomical
    coordinates. Raises SetUpError."""
    beam = femur.base_mm / 2 - source_mm
    beam = beam / np.linalg.norm(beam)
    across = np.cross(beam, femur.towards_head)
    across = across / np.linalg.norm(across)
    if abs(beam @ femur.towards_head) > ACROSS:
        on = [station * femur.base_mm for station in HIDDEN]
        return np.array([[femur.surface_mm(at, way * across) for at in on] for way in (1.0, -1.0)])
    borders = [_border(femur, source_mm, beam, way * across) for way in (1.0, -1.0)]
    apart = np.linalg.norm(borders[0][:, None] - borders[1], axis=-1)
    narrowest = np.unravel_index(apart.argmin(), apart.shape)
    out = []
    for border, at in zip(borders, narrowest, strict=True):
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(border, axis=0), axis=1))])
        near = np.linalg.norm(border, axis=1) <= rng.uniform(*BESIDE_HEAD) * femur.head_radius_mm
        first = along[np.flatnonzero(near)[-1]] if near.any() else 0.0
        places = first, min(along[at] + rng.uniform(*PAST_MM), along[-1])
        out.append([[np.interp(place, along, border[:, k]) for k in range(3)] for place in places])
    return np.array(out)


def _border(femur: Femur, source_mm: np.ndarray, beam: np.ndarray, sideways: np.ndarray) -> np.ndarray:
    """Return the outline (K, 3) on one side of the neck, up to where it leaps to the trochanter, as the source (3,)
    sees it in the plane through the head's centre across the beam (3,)."""
    seen = []
    for station in STATIONS:
        on, touched = station * femur.base_mm, []
        for depth in DEPTHS_MM:
            try:
                ray = femur.surface_mm(on + depth * beam, sideways) - source_mm
            except SetUpError:  # outside the bone
                continue
            touched.append(source_mm - ray * (source_mm @ beam) / (ray @ beam))
        seen.append(max(touched, key=lambda at: float(at @ sideways)))
        if len(seen) > len(STATIONS) / 4 and np.linalg.norm(seen[-1] - seen[-2]) > 1.0:
            return np.array(seen[:-1])
    return np.array(seen)
