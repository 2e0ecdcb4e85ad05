"""From a scene to a radiograph: expected quanta per pixel, Poisson noise, detector blur, digitisation.

The quanta absorbed in each pixel's area of the input plane are drawn first (Poisson) and blurred afterwards, because
the noise of an image intensifier is correlated. A pixel near the edge collects from a smaller area (pincushion); with
the glare lost there, this is the vignetting. Not modelled: the energy dependence of the detector's response, the
inverse square of the distance within the field (under 2 %), the heel effect.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
from scipy.fft import next_fast_len
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates

from sightline.common.threads import at_once
from sightline.errors import SetUpError
from sightline.imaging import Radiograph
from sightline.imaging.volumes.beam import attenuation_per_mm, excess_per_mm, spectrum
from sightline.imaging.volumes.meshes import Mesh
from sightline.imaging.volumes.rays import Rays, volume_integral
from sightline.imaging.volumes.volume import Volume
from sightline.twin.objects.things import RADIUS, Box, Scene, pack, plate_scene, stations
from sightline.twin.xray.presets import ImageChain, Video
from sightline.twin.xray.projector import CELL_PX, box_length, mesh_lengths, solid_transmission
from sightline.twin.xray.setup import SetUp, ViewTruth, shadow_radius_px

RAY_MARGIN_PX = 6  # rays are cast this far beyond the blanking, as input of the blur
RAY_GRID_PX = 8  # the inverse distortion is exact on this grid, splines between: error below 1e-5 px
# S.d. of the scatter kernel at the input plane. Scatter behind slabs spreads as a Gaussian [src Med Phys 13:254 1986].
# The best kernels for head, chest and pelvis phantoms had a full width at half maximum of 50-150 of 512 pixels across
# fields of 15-36 cm [src Med Phys 14:178 1987]: s.d. 6-45 mm [calc].
SCATTER_MM = 30.0  # [ours] within that range
# Thickness of tissue, mm, at which the ratio of scatter to primary is that of the chain; it grows in proportion [ours].
# It is the equivalent of drawn hips with bone and plates, mean of PA and lateral [calc].
HIP_MM = 250.0
MAX_TISSUE_MM = 600.0  # thicker tissue counts as this
COARSE_PX = 8  # scatter and glare are computed on means of this many pixels
FINE_VOXEL_MM = 0.5  # [ours] volumes with finer voxels are cast for every pixel, since a pixel sees their steps
MEAN_LEVEL = 0.25  # [ours, typical] these three: of the white level: mean of the image's middle after exposure control
BLACK_LEVEL = 0.02  # of the white level
ELECTRONIC_SD = 0.0006  # of the white level: 2.5 of 4095


@dataclass(frozen=True)
class Dose:
    """Kerma at the intensifier: 0.11-0.44 µGy/s [src ARCADIS manual], 25 frames a second, `frames` of them averaged.

    `level`: mean of the image's middle after exposure control, as a share of the white level.
    """

    rate_ugy_s: float = 0.44
    frames: int = 8
    level: float = MEAN_LEVEL

    def quanta(self, chain: ImageChain) -> float:
        """Return the mean quanta counted per pixel: K/25 · frames · 3e4/mm²/µGy · pitch² · DQE [calc]."""
        return self.rate_ugy_s / 25 * self.frames * 3e4 * chain.pitch_mm**2 * chain.dqe


# 15, 121 and 484 quanta per pixel of the 9 in chain: fluoroscopy, a held image, a digital spot [ours].
DOSES = {"low": Dose(frames=1), "medium": Dose(frames=8), "high": Dose(frames=32)}


@dataclass(frozen=True, eq=False)
class Exposure:
    """An exposure before noise. `quanta` (H, W): expected number per pixel, scatter included, before any blur.

    `open_quanta` (H, W): the same without the sharp objects, scatter unchanged. `field` (H, W): inside the blanking.
    `core_px`: s.d. of the detector's Gaussian blur. `gain`: stored values per quantum.
    """

    chain: ImageChain
    quanta: np.ndarray
    open_quanta: np.ndarray
    field: np.ndarray
    core_px: float
    gain: float

    @property
    def black(self) -> float:
        """The stored value without light."""
        return BLACK_LEVEL * self.chain.white

    def mean_pixels(self) -> np.ndarray:
        """Return the image (H, W), float32, without noise and digitisation, in stored values."""
        return self._blanked(self._light(self.quanta))

    def open_pixels(self) -> np.ndarray:
        """Return `mean_pixels` without the sharp objects."""
        return self._blanked(self._light(self.open_quanta))

    def read_out(
        self, rng: np.random.Generator, second: "Exposure | None" = None, former: "Sequence[Exposure]" = ()
    ) -> Radiograph:
        """Draw a radiograph: Poisson counts, blur, effects of a video camera, electronic noise, whole numbers up to
        white.

        For an interlaced chain with movement: `second` is the view at the time of the second field; `former` are the
        views at earlier fields, the latest first, the last of which lasted before. The camera's lag adds a trail of
        these, without their noise. Raises SetUpError if the chain has no video camera.
        """
        if (second is not None or former) and self.chain.video is None:
            raise SetUpError(f"image chain {self.chain.name!r} reads whole frames; it has no second field and no lag")
        image = self._light(rng.poisson(self.quanta).astype(np.float32))
        noise = ELECTRONIC_SD
        if (video := self.chain.video) is not None:
            counts = rng.poisson((second or self).quanta).astype(np.float32)
            fields = [image, (second or self)._light(counts)]
            if former:
                fields = trailed(fields, [exposure._light(exposure.quanta) for exposure in (self, *former)], video.lag)
            image = grabbed(fields[0], fields[1], self.black, video, rng)
            noise = video.noise
        image += np.float32(noise * self.chain.white) * rng.standard_normal(image.shape, dtype=np.float32)
        stored = np.clip(np.rint(image), 0, self.chain.white).astype(np.uint16)
        stored[~self.field] = 0
        return Radiograph(stored, float(self.chain.white))

    def _light(self, quanta: np.ndarray) -> np.ndarray:
        blurred = _detector_blur(quanta, self.chain, self.core_px)
        return np.float32(self.black) + np.float32(self.gain) * blurred

    def _blanked(self, image: np.ndarray) -> np.ndarray:
        image[~self.field] = 0
        return image


def render(setup: SetUp, view: str, scene: Scene, rng: np.random.Generator, dose: Dose | None = None) -> Radiograph:
    """Draw the radiograph of a scene in one view of a set-up, with the plate on the detector where its frame has one.

    Equal generator states give equal images.
    """
    return expose(setup.views[view], scene + plate_scene(setup.frame_in(view)), dose).read_out(rng)


def render_views(setup: SetUp, views: Sequence[str], scene: Scene, rng: np.random.Generator) -> dict[str, Radiograph]:
    """Draw the radiographs of a scene in several views: those of `render`, one after another, with one generator.

    Threads compute what is expected; noise is drawn in order.
    """
    jobs = [partial(expose, setup.views[view], scene + plate_scene(setup.frame_in(view))) for view in views]
    return {view: exposure.read_out(rng) for view, exposure in zip(views, at_once(*jobs), strict=True)}


def expose(
    view: ViewTruth,
    scene: Scene,
    dose: Dose | None = None,
    *,
    even_scatter: bool = False,
    scatter_mm: float = SCATTER_MM,
) -> Exposure:
    """Return the expected image of a scene at a dose (default: "medium"), with exposure control on the image's middle.

    Scatter depends on the tissue in the beam; with `even_scatter` it is the chain's share of the primary everywhere.
    `scatter_mm`: s.d. of the scatter kernel; infinite: uniform scatter. Raises SetUpError if nothing passes the middle.
    """
    return project(view, scene).exposed(dose, even_scatter=even_scatter, scatter_mm=scatter_mm)


@dataclass(frozen=True, eq=False)
class Projection:
    """The primary radiation of a scene in one view, from which exposures of any dose and scatter are made.

    `arriving` (H, W): photons per pixel, relative to a pixel of the open beam in the middle; `without`: the same
    without the sharp objects. `area` (H, W): of each pixel relative to the middle's. `inside` (H, W): where rays were
    cast.
    """

    view: ViewTruth
    arriving: np.ndarray
    without: np.ndarray
    area: np.ndarray
    inside: np.ndarray

    def exposed(
        self, dose: Dose | None = None, *, even_scatter: bool = False, scatter_mm: float = SCATTER_MM
    ) -> Exposure:
        """Return the expected image; see `expose`. Raises SetUpError if nothing passes the middle."""
        chain, dose, arriving = self.view.chain, dose or DOSES["medium"], self.arriving
        tissue = 1.0 if even_scatter else tissue_mm(self.without / self.area, chain.spectrum) / HIP_MM
        scattered = chain.scatter_to_primary * _spread(arriving * tissue, self.inside, scatter_mm / chain.pitch_mm)
        rim = _rim_px(chain)
        level = float((arriving + scattered)[rim > 0.5 * chain.mask_px].mean())
        if not level > 0:
            raise SetUpError("no radiation passes the middle of the scene; remove objects from the beam")
        wanted = dose.quanta(chain)
        quanta, open_quanta = (
            np.where(self.inside, wanted / level * (p + scattered), 0.0) for p in (arriving, self.without)
        )
        jacobian = self.view.intensifier.jacobian(np.zeros((1, 2)))[0]
        return Exposure(
            chain=chain,
            quanta=quanta,
            open_quanta=open_quanta,
            field=rim >= 0,
            core_px=chain.core_mm * float(np.sqrt(np.linalg.det(jacobian))),
            gain=dose.level * chain.white / wanted,
        )


def project(view: ViewTruth, scene: Scene) -> Projection:
    """Cast the rays of a scene once, for exposures at several doses and scatters."""
    rays, area = pixel_rays(view)
    arriving, without = (share * area for share in primary(view, scene, rays))
    return Projection(view, arriving, without, area, rays.inside)


def _spread(source: np.ndarray, inside: np.ndarray, sd_px: float) -> np.ndarray:
    """Spread the scatter of each pixel in the field `inside` with the kernel; with an infinite `sd_px` uniformly.

    The result is normalised by the part of the kernel inside the field, since the body beyond the edge scatters too.
    """
    if np.isinf(sd_px):
        return np.full(source.shape, source[inside].mean())
    return _smooth(source, sd_px) / np.maximum(_smooth(inside, sd_px), 0.1)


def tissue_mm(transmission: np.ndarray, beam: str) -> np.ndarray:
    """Return the thickness (...) of soft tissue, mm, with a given transmission of a spectrum, at most MAX_TISSUE_MM."""
    lengths = np.linspace(0.0, MAX_TISSUE_MM, 241)
    left = np.exp(-lengths[:, None] * attenuation_per_mm("tissue", beam)) @ spectrum(beam).weights
    return np.interp(-np.log(np.maximum(transmission, left[-1])), -np.log(left), lengths)


def grabbed(first: np.ndarray, second: np.ndarray, black: float, video: Video, rng: np.random.Generator) -> np.ndarray:
    """Return the frame (H, W), float32, grabbed from two fields, each given as a whole image, before noise."""
    h, w = first.shape
    v, u = np.mgrid[:h, :w].astype(np.float64)
    u += video.jitter_px * rng.standard_normal((h, 1))
    frame = np.empty_like(first)
    frame[::2] = map_coordinates(first, [v[::2], u[::2]], mode="nearest")
    lower = map_coordinates(second, [v[1::2] + video.pairing_px, u[1::2]], mode="nearest")
    frame[1::2] = black + (1 + video.field_gain) * (lower - black)
    return frame


def trailed(fields: Sequence[np.ndarray], before: Sequence[np.ndarray], lag: float) -> list[np.ndarray]:
    """Return two fields (H, W) with the trail of a camera's lag. `before` (H, W): the light of the first one, then that
    of the earlier fields, the latest first."""
    trail = before[-1]
    for light in reversed(before[1:-1]):
        trail = (1 - lag) * light + lag * trail
    return [(1 - lag) * fields[0] + lag * trail, (1 - lag) * fields[1] + lag * ((1 - lag) * before[0] + lag * trail)]


@lru_cache(maxsize=2)
def _rim_px(chain: ImageChain) -> np.ndarray:
    """Return the distance (H, W) of each pixel from the edge of the field, negative outside."""
    h, w = chain.shape
    rim = chain.rim_px(np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1))
    rim.flags.writeable = False
    return rim


def pixel_rays(view: ViewTruth) -> tuple[Rays, np.ndarray]:
    """Return a ray for every pixel, and the pixels' areas (H, W) on the input plane relative to that of the middle."""
    h, w = view.chain.shape
    u = np.arange(-RAY_GRID_PX, w + 2 * RAY_GRID_PX, RAY_GRID_PX, dtype=np.float64)
    v = np.arange(-RAY_GRID_PX, h + 2 * RAY_GRID_PX, RAY_GRID_PX, dtype=np.float64)
    inside = _rim_px(view.chain) >= -RAY_MARGIN_PX
    inside[[0, -1]] = inside[:, [0, -1]] = False  # sub-rays need the neighbouring pixels
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    towards = grid - view.intensifier.centre_px
    reach = np.linalg.norm(towards, axis=-1, keepdims=True)
    bound = view.chain.reach_px + 10 * RAY_GRID_PX  # the grid's corners, which need no ray, move in towards the field
    xi = view.intensifier.to_detector(
        view.intensifier.centre_px + towards * np.minimum(1, bound / np.maximum(reach, 1))
    )
    splines = [RectBivariateSpline(v, u, xi[..., k]) for k in range(2)]
    pv, pu = np.arange(h), np.arange(w)
    x, y = (s(pv, pu) for s in splines)
    slopes = [(s(pv, pu, dy=1), s(pv, pu, dx=1)) for s in splines]
    area = slopes[0][0] * slopes[1][1] - slopes[0][1] * slopes[1][0]
    points = x[..., None] * view.detector.axes[0]
    points += view.detector.origin_mm
    points += y[..., None] * view.detector.axes[1]
    return Rays(view.focal_point_mm, points, inside), area / area[h // 2, w // 2]


def primary(view: ViewTruth, scene: Scene, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return the share (H, W) of an open beam's photons that arrive unscattered, with and without balls and rods."""
    beam = view.chain.spectrum
    layers = list(_layers(scene, rays, beam))
    shapes, excess = pack(scene.solids, beam)
    spot = view.chain.focal_spot_mm * view.detector.axes
    sharp = solid_transmission(rays, spot, _cells(view, shapes), (shapes, excess))
    meshes = [
        (excess_per_mm(mesh.material, mesh.within, beam), *_mesh_mm(view, mesh, rays, spot)) for mesh in scene.meshes
    ]
    arriving, without = np.zeros(rays.inside.shape), np.zeros(rays.inside.shape)
    for e, weight in enumerate(spectrum(beam).weights):
        depth = np.zeros(rays.inside.shape, dtype=np.float32)
        for length, per_mm in layers:
            depth = depth + length * np.float32(per_mm[e])
        soft = weight * np.exp(-depth)
        for per_mm, hit, lengths in meshes:
            soft[hit] *= np.exp(-lengths * np.float32(per_mm[e])).mean(axis=0)
        without += soft
        arriving += soft * sharp[e]
    return np.where(rays.inside, arriving, 0.0), np.where(rays.inside, without, 0.0)


def _layers(scene: Scene, rays: Rays, beam: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the lengths (H, W), mm, in volumes, body and boxes, and the attenuation (N,) of each, 1/mm.

    Objects set into tissue shorten the length in the body, at most to zero.
    """
    displaced = np.zeros(rays.inside.shape, dtype=np.float32)
    for volume in scene.volumes:
        length = _volume_mm(volume, rays)
        in_body = volume.within == "tissue"
        displaced += length if in_body else 0
        yield length, excess_per_mm(volume.material, None if in_body else volume.within, beam)
    if scene.tissue is not None:
        body = scene.tissue.length_mm(rays.focal, rays.points)
        yield np.maximum(body - displaced, 0.0), attenuation_per_mm("tissue", beam)
    for (material, within), boxes in _alike(scene.boxes).items():
        parts = [np.stack([getattr(box, name) for box in boxes]) for name in ("centre_mm", "axes", "half_mm")]
        yield box_length(rays, *parts), excess_per_mm(material, within, beam)


def _alike(boxes: tuple[Box, ...]) -> dict[tuple[str, str | None], list[Box]]:
    """Group boxes by material and surrounding material, to be cast together."""
    groups: dict[tuple[str, str | None], list[Box]] = {}
    for box in boxes:
        groups.setdefault((box.material, box.within), []).append(box)
    return groups


def _volume_mm(volume: Volume, rays: Rays) -> np.ndarray:
    """Return the length (H, W), mm, in a volume along each ray.

    If a voxel's shadow is wide enough (that of 0.75 mm is six pixels), every second pixel is cast, with cubic
    interpolation between.
    """
    own = volume.axes.T
    focal, origin = rays.focal @ own, volume.origin_mm @ own
    if volume.voxel_mm.min() < FINE_VOXEL_MM:
        return volume_integral(Rays(focal, rays.points @ own, rays.inside), volume.values, origin, volume.voxel_mm)
    # Grown by four pixels, the support of the cubic interpolation between rays.
    inside = np.ascontiguousarray(cv2.dilate(rays.inside.astype(np.uint8), np.ones((9, 9), np.uint8))[::2, ::2] > 0)
    every = Rays(focal, rays.points[::2, ::2] @ own, inside)
    length = volume_integral(every, volume.values, origin, volume.voxel_mm)
    halve = np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])
    h, w = rays.inside.shape
    fine = cv2.warpAffine(
        length, halve, (w, h), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    return np.maximum(fine, 0.0)


def _mesh_mm(view: ViewTruth, mesh: Mesh, rays: Rays, spot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels (H, W) bool a mesh shadows, and the lengths (S, N), mm, in it along the S sub-rays of each.

    Raises OutsideRegionError for a mesh behind the source.
    """
    corners = view.to_detector(mesh.vertices_mm)[mesh.triangles]
    source = view.detector.height_mm(view.focal_point_mm)
    nearest = 1 - view.detector.height_mm(mesh.vertices_mm).min() / source  # share of the source-detector distance
    margin = (view.chain.pitch_mm + view.chain.focal_spot_mm * (1 / nearest - 1)) / 2  # sub-rays reach half of it
    shadows = np.concatenate([corners.min(axis=1) - margin, corners.max(axis=1) + margin], axis=1)
    surface = mesh.vertices_mm, mesh.triangles
    lengths = mesh_lengths(rays, view.detector.to_plane(rays.points), spot, surface, shadows)
    hit = np.asarray(lengths.any(axis=0))
    return hit, lengths[:, hit]


def _cells(view: ViewTruth, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the solids that may touch each cell of the image: for cell i, index[first[i]:first[i + 1]]."""
    h, w = view.chain.shape
    tall, wide = -(-h // CELL_PX), -(-w // CELL_PX)
    touched = np.zeros((tall * wide, len(shapes)), dtype=bool)
    places, owner = stations(shapes)
    uv = view.project(places)
    margin = 4.0 + 1.5 * shadow_radius_px(view, places, shapes[owner, RADIUS])[:, None]
    low = np.floor((uv - margin) / CELL_PX).astype(int)
    high = np.floor((uv + margin) / CELL_PX).astype(int) + 1
    for m, (c0, r0), (c1, r1) in zip(owner, low, high, strict=True):
        rows, columns = np.arange(max(r0, 0), min(r1, tall)), np.arange(max(c0, 0), min(c1, wide))
        touched[(rows[:, None] * wide + columns).ravel(), m] = True
    first = np.concatenate([[0], np.cumsum(touched.sum(axis=1))])
    return first.astype(np.int64), np.nonzero(touched)[1].astype(np.int64)


def _coarse(image: np.ndarray) -> np.ndarray:
    """Return means of COARSE_PX x COARSE_PX pixels."""
    h, w = image.shape
    return cv2.resize(image, (-(-w // COARSE_PX), -(-h // COARSE_PX)), interpolation=cv2.INTER_AREA)


def _fine(coarse: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a coarse image at full size, by linear interpolation."""
    return cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)


def _smooth(image: np.ndarray, sd_px: float) -> np.ndarray:
    """Apply a wide Gaussian blur, with no light outside the image."""
    coarse = _coarse(np.ascontiguousarray(image, dtype=np.float32))
    return _fine(cv2.GaussianBlur(coarse, (0, 0), sd_px / COARSE_PX, borderType=cv2.BORDER_CONSTANT), image.shape)


def _detector_blur(light: np.ndarray, chain: ImageChain, core_px: float) -> np.ndarray:
    """Apply the detector blur: a Gaussian core, and veiling glare (1 - g) delta + g exp(-r/k) / (2 pi k r)."""
    image = np.ascontiguousarray(light, dtype=np.float32)
    core = cv2.GaussianBlur(image, (0, 0), core_px, borderType=cv2.BORDER_CONSTANT)
    if chain.glare == 0:
        return core
    coarse = _coarse(image)
    reach = chain.glare_mm / chain.pitch_mm / COARSE_PX
    veil = _fine(_convolve(coarse, _glare_kernel(max(coarse.shape), reach)), image.shape)
    return (1 - chain.glare) * core + chain.glare * veil


def _glare_kernel(half: int, reach: float) -> np.ndarray:
    """Return exp(-r/k)/r of unit sum on a lattice of 2 half + 1 cells; the middle cell holds its integral over a disc
    of the same area."""
    side = np.arange(-half, half + 1)
    r = np.hypot(side, side[:, None])
    r[half, half] = 1.0
    kernel = np.exp(-r / reach) / r / (2 * np.pi * reach)
    kernel[half, half] = 1 - np.exp(-1 / np.sqrt(np.pi) / reach)
    return (kernel / kernel.sum()).astype(np.float32)


def _convolve(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return the linear convolution, cropped to the image."""
    size = [int(next_fast_len(a + b - 1) or 0) for a, b in zip(image.shape, kernel.shape, strict=True)]
    full = np.fft.irfft2(np.fft.rfft2(image, size) * np.fft.rfft2(kernel, size), size)
    half = kernel.shape[0] // 2
    return full[half : half + image.shape[0], half : half + image.shape[1]].astype(np.float32)
