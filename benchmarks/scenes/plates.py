"""Random scenes for `label`: the beads of one view of a frame as detection would report them, with the truth.

The distribution was committed before `label` was tuned; only the noise of centres and radii was set later, from what
`detect` reports in rendered images. Scenes consist of points; nothing is rendered.
"""

from dataclasses import dataclass

import numpy as np

from sightline.detection import Detections
from sightline.frame import Frame, FrameView
from sightline.twin import bead_images, draw_setup
from sightline.twin.xray.setup import shadow_radius_px

SOURCE_HIP_MM = 620.0  # physics.md, C-arm and image chain [ours]
SOURCE_DETECTOR_MM = 1000.0  # [src ARCADIS manual]
FIELD_RADIUS_MM = 107.5  # 9 in intensifier, useful field [mem]
AIM_MM = 15.0  # largest offset of the beam from the middle between the plates, uniform per axis [ours]
SIDES_PX = (1024, 576)  # modern CCD; PAL frame grabber [mem]
# Of `detect` in 108 rendered images of the built-in frames [twin]: scatter of centres 0.03-0.06 px at high dose,
# 0.05-0.09 at medium, 0.12-0.18 at low; radii of a plate 0.98-1.03 of the truth, their scatter 0.3-3.6 %.
CENTRE_NOISE_PX = (0.03, 0.2)
RADIUS_FACTOR, RADIUS_NOISE = (0.98, 1.04), (0.005, 0.035)
MISJUDGED = 0.02  # share of beads whose radius is far off [ours]
RADIUS_RANGE_PX = (2.0, 25.0)  # the range of `detect`


@dataclass(frozen=True)
class Hiding:
    """How beads are hidden: the largest share hidden or outside the field, at random or as one block."""

    most: float = 0.4
    block: bool | None = None  # None: either, by chance


@dataclass(frozen=True, eq=False)
class Scene:
    """One image's detections and the truth about them.

    `truth[i]` holds the fiducials that detection i shows: none for a false candidate, two where a pair has merged.
    `solvable`: three datum markers of each plate, not on one line, are among the detections.
    """

    detections: Detections
    truth: tuple[frozenset[str], ...]
    view: str
    mirrored: bool
    solvable: bool


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _across(direction: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return two random unit vectors (2, 3) perpendicular to a direction; right-handed with it."""
    first = _unit(np.cross(direction, rng.standard_normal(3)))
    return np.stack([first, np.cross(direction, first)])


@dataclass(frozen=True, eq=False)
class Camera:
    """A C-arm with an intensifier, seen along the beam."""

    focal_point_mm: np.ndarray
    axes: np.ndarray  # (3, 3): across, across, along the beam
    pincushion: float
    rotation_rad: float
    shift_mm: np.ndarray
    waves: tuple[np.ndarray, np.ndarray, np.ndarray]  # random smooth remainder: frequency, phase, amplitude
    side_px: int
    mirrored: bool

    def project(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) of points (N, 3), and whether they lie in the field."""
        local = (xyz_mm - self.focal_point_mm) @ self.axes.T
        q = SOURCE_DETECTOR_MM * local[:, :2] / local[:, 2:]
        inside = np.hypot(*q.T) <= FIELD_RADIUS_MM
        uv = self._distorted(q) * (0.49 * self.side_px / FIELD_RADIUS_MM)
        if self.mirrored:
            uv[:, 0] *= -1.0
        return uv + (self.side_px - 1) / 2, inside

    def _distorted(self, q: np.ndarray) -> np.ndarray:
        """Apply pincushion, S-shaped rotation and shift (physics.md, Distortion), and a smooth random remainder."""
        u2 = np.minimum((q**2).sum(axis=1, keepdims=True) / FIELD_RADIUS_MM**2, 1.0)
        phi = self.rotation_rad * (1.0 - 0.79 * u2 + 0.23 * u2**2)
        turned = q * np.cos(phi) + np.stack([-q[:, 1], q[:, 0]], axis=1) * np.sin(phi)
        out = turned * (1.0 + self.pincushion * u2) / (1.0 + self.pincushion)
        out = out + self.shift_mm * (1.0 - 1.41 * u2 + 0.88 * u2**2)
        frequency, phase, amplitude = self.waves
        return out + np.cos(q @ frequency.T + phase) @ amplitude


def draw_camera(rng: np.random.Generator, view: FrameView) -> Camera:
    """Return a C-arm for one view of a frame: tilt up to 20°, any rotation, an intensifier's distortion."""
    xrii, source = view.xrii.xyz_mm.mean(axis=0), view.source.xyz_mm.mean(axis=0)
    beam = _unit(xrii - source)
    tilt = np.radians(rng.uniform(0.0, 20.0))
    along = np.cos(tilt) * beam + np.sin(tilt) * _across(beam, rng)[0]
    middle = (xrii + source) / 2
    aim = middle + rng.uniform(-AIM_MM, AIM_MM, 2) @ _across(beam, rng)
    focal = aim - (SOURCE_HIP_MM + middle @ beam) * along
    waves = 64
    remainder_mm = rng.uniform(0.05, 0.1)  # after a fit of degree 5 [calc, physics.md]; cubic part below
    length_mm = rng.uniform(30.0, 60.0)
    frequency = np.concatenate([rng.standard_normal((waves, 2)) / length_mm, rng.standard_normal((8, 2)) / 120.0])
    amplitude = np.concatenate(
        [
            rng.standard_normal((waves, 2)) * remainder_mm * np.sqrt(2.0 / waves),
            rng.standard_normal((8, 2)) * 0.4 * np.sqrt(2.0 / 8),
        ]
    )
    return Camera(
        focal_point_mm=focal,
        axes=np.concatenate([_across(along, rng), along[None]]),
        pincushion=rng.uniform(0.03, 0.09),
        rotation_rad=np.radians(rng.uniform(-4.0, 4.0)),
        shift_mm=rng.uniform(-3.0, 3.0, 2),
        waves=(frequency, rng.uniform(0, 2 * np.pi, len(frequency)), amplitude),
        side_px=int(rng.choice(SIDES_PX, p=(0.7, 0.3))),
        mirrored=bool(rng.random() < 0.5),
    )


def _radii_px(camera: Camera, view: FrameView, uv: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return radii as detection reports them: the local scale, a common factor, and a few per cent of noise."""
    xyz = np.array([f.xyz_mm for f in view.fiducials])
    half = np.array([f.diameter_mm for f in view.fiducials]) / 2
    steps = [np.linalg.norm(camera.project(xyz + camera.axes[k] * half[:, None])[0] - uv, axis=1) for k in (0, 1)]
    radii = (
        np.sqrt(steps[0] * steps[1])
        * rng.uniform(*RADIUS_FACTOR)
        * (1.0 + rng.uniform(*RADIUS_NOISE) * _normal(rng, uv))
    )
    far_off = rng.random(len(uv)) < MISJUDGED
    return np.where(far_off, radii * rng.uniform(0.7, 1.4, len(uv)), radii)


def _normal(rng: np.random.Generator, like: np.ndarray) -> np.ndarray:
    return np.clip(rng.standard_normal(len(like)), -3.0, 3.0)


def _hidden(rng: np.random.Generator, uv: np.ndarray, inside: np.ndarray, hiding: Hiding) -> np.ndarray:
    """Return (N,) bool: beads outside the field, and further hidden ones up to a share drawn from 0 to `most`."""
    out = ~inside
    number = round(rng.uniform(0.0, hiding.most) * len(uv)) - int(out.sum())
    if number <= 0:
        return out
    block = rng.random() < 0.5 if hiding.block is None else hiding.block
    visible = np.flatnonzero(inside)
    if block:
        near = np.linalg.norm(uv[visible] - uv[rng.choice(visible)], axis=1)
        chosen = visible[np.argsort(near)[:number]]
    else:
        chosen = rng.choice(visible, number, replace=False)
    out[chosen] = True
    return out


@dataclass
class _Seen:
    uv: list[np.ndarray]
    radius: list[float]
    truth: list[frozenset[str]]

    def add(self, uv_px: np.ndarray, radius_px: float, ids: frozenset[str]) -> None:
        self.uv.append(uv_px)
        self.radius.append(radius_px)
        self.truth.append(ids)


def _merged(ids: list[str], uv: np.ndarray, radius: np.ndarray, rng: np.random.Generator) -> _Seen:
    """Return beads as detection reports them: an overlapping pair becomes one blob, one of the two, none, or both."""
    seen = _Seen([], [], [])
    gone: set[int] = set()
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    for i in range(len(ids)):
        if i in gone:
            continue
        near = [j for j in range(i + 1, len(ids)) if j not in gone and distance[i, j] < radius[i] + radius[j]]
        if not near:
            seen.add(uv[i], radius[i], frozenset({ids[i]}))
            continue
        j = near[0]
        gone.add(j)
        weight = radius[[i, j]] ** 2 / (radius[[i, j]] ** 2).sum()
        fate = (
            rng.choice(("blob", "one", "none", "both")) if distance[i, j] > 0.6 * max(radius[i], radius[j]) else "blob"
        )
        if fate == "blob":
            seen.add(
                weight @ uv[[i, j]],
                max(radius[i], radius[j], (distance[i, j] + radius[i] + radius[j]) / 2),
                frozenset({ids[i], ids[j]}),
            )
        for k in {"one": [i], "both": [i, j]}.get(str(fate), []):
            seen.add(uv[k], radius[k], frozenset({ids[k]}))
    return seen


def _add_false(
    rng: np.random.Generator, seen: _Seen, radii: tuple[np.ndarray, np.ndarray], number: int, side: int
) -> None:
    """Add false candidates in the field: most of any size, a fifth like ordinary beads, a fifth like datums."""
    while number > 0:
        uv = (side - 1) / 2 + rng.uniform(-0.49, 0.49, 2) * side
        size = rng.random()
        if size < 0.6:
            radius = float(np.exp(rng.uniform(*np.log(RADIUS_RANGE_PX))))
        else:
            radius = float(rng.choice(radii[int(size > 0.8)]) * (1 + rng.uniform(-0.05, 0.05)))
        apart = all(np.linalg.norm(uv - p) > max(radius, r) for p, r in zip(seen.uv, seen.radius, strict=True))
        if apart and np.hypot(*(uv - (side - 1) / 2)) < 0.49 * side:
            seen.add(uv, radius, frozenset())
            number -= 1


def _spread_mm(xyz_mm: np.ndarray) -> float:
    """Return the rms distance of points from the best line."""
    if len(xyz_mm) < 3:
        return 0.0
    return float(np.linalg.svd(xyz_mm - xyz_mm.mean(axis=0))[1][1] / np.sqrt(len(xyz_mm)))


def draw_scene(
    rng: np.random.Generator, frame: Frame, view: str | None = None, hiding: Hiding | None = None, false: int = 10
) -> Scene:
    """Return a random scene of one view of `frame` (any by default); at most `hiding.most` of its beads are missing."""
    hiding = hiding or Hiding()
    name = view or str(rng.choice(list(frame.views)))
    fiducials = frame.view(name).fiducials
    xyz = np.array([f.xyz_mm for f in fiducials])
    while True:
        camera = draw_camera(rng, frame.view(name))
        uv, inside = camera.project(xyz)
        if (~inside).mean() <= hiding.most:
            break
    kept = np.flatnonzero(~_hidden(rng, uv, inside, hiding))
    radii = _radii_px(camera, frame.view(name), uv, rng)
    is_datum = np.array([f.datum for f in fiducials])
    noise_px = rng.uniform(*CENTRE_NOISE_PX)
    shown = uv + noise_px * rng.standard_normal(uv.shape)
    seen = _merged([fiducials[i].id for i in kept], shown[kept], radii[kept], rng)
    single = {next(iter(ids)) for ids in seen.truth if len(ids) == 1}
    shapes = ["ball"] * (len(seen.uv) + false)
    for k, ids in enumerate(seen.truth):
        shapes[k] = "washer" if any(frame.view(name).by_id[i].shape == "washer" for i in ids) else "ball"
    _add_false(rng, seen, (radii[~is_datum], radii[is_datum]), false, camera.side_px)
    order = rng.permutation(len(seen.uv))
    count = len(order)
    stated = noise_px * rng.uniform(0.7, 1.4, count)
    detections = Detections(
        uv_px=np.array(seen.uv).reshape(-1, 2)[order],
        radius_px=np.array(seen.radius)[order],
        covariance_px2=stated[:, None, None] ** 2 * np.eye(2),
        kind=tuple(shapes[i] for i in order),
        contrast=np.full(count, -0.5),
        image_shape=(camera.side_px, camera.side_px),
    )
    truth = tuple(seen.truth[i] for i in order)
    return Scene(detections, truth, name, camera.mirrored, _solvable(frame.view(name), single))


def _solvable(view: FrameView, single: set[str]) -> bool:
    """Return whether the isolated fiducials include three datum markers of each plate, not on one line."""
    left = [[f.xyz_mm for f in plate.fiducials if f.datum and f.id in single] for plate in (view.xrii, view.source)]
    return all(_spread_mm(np.array(p).reshape(-1, 3)) > 5.0 for p in left)


CLEAN_NOISE_PX, CLEAN_RADIUS_NOISE = 0.06, 0.01  # of `detect` at medium dose, as above [twin]
CROPS = (0.6, 1.0)  # share of each side that a crop leaves, uniform [ours]


def clean_views(rng: np.random.Generator, frame: Frame, chain: str, *, cropped: bool = False) -> list[Scene]:
    """Return both views of a set-up with the twin's image chain: all beads completely in the field, nothing else.

    `cropped`: to a random rectangle of the image, without the beads at its border.
    """
    setup = draw_setup(rng, frame, chain=chain)
    out = []
    for name, truth in setup.views.items():
        ids, uv = bead_images(setup, name, rng, sd_px=CLEAN_NOISE_PX)
        by_id = setup.true_frame.view(name).by_id
        beads = [by_id[name] for name in ids]
        half = np.array([bead.diameter_mm / 2 for bead in beads])
        radius = shadow_radius_px(truth, np.array([bead.xyz_mm for bead in beads]), half)
        size = np.array(truth.chain.shape[::-1])
        left_top = np.zeros(2, int)
        if cropped:
            whole, size = size, np.rint(size * rng.uniform(*CROPS, 2)).astype(int)
            left_top = rng.integers(0, whole - size + 1)
        uv = uv - left_top
        kept = np.flatnonzero(((uv > radius[:, None]) & (uv < size - 1 - radius[:, None])).all(axis=1))
        single = {ids[k] for k in kept}
        out.append(
            Scene(
                detections=Detections(
                    uv_px=uv[kept],
                    radius_px=radius[kept] * (1 + CLEAN_RADIUS_NOISE * _normal(rng, kept)),
                    covariance_px2=np.tile(CLEAN_NOISE_PX**2 * np.eye(2), (len(kept), 1, 1)),
                    kind=tuple(beads[k].shape for k in kept),
                    contrast=np.full(len(kept), -0.5),
                    image_shape=(int(size[1]), int(size[0])),
                ),
                truth=tuple(frozenset({ids[k]}) for k in kept),
                view=name,
                mirrored=False,
                solvable=_solvable(frame.view(name), single),
            )
        )
    return out
