"""Hard images to test detection: bone edges, metal, low dose, saturation, vignetting, the edge of the field."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.common.names import named
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin.objects.things import CENTRE, RADIUS, Rod, Scene, SoftTissue, Solid, pack, stations
from sightline.twin.scenes.hip_scene import hip_scene
from sightline.twin.xray.distributions import HardScene
from sightline.twin.xray.render import DOSES, SCATTER_MM, Exposure, Projection, project
from sightline.twin.xray.setup import SetUp, ViewTruth, draw_setup, shadow_centres_px, shadow_radius_px


@dataclass(frozen=True, eq=False)
class BeadTruth:
    """The truth of the N beads of a frame whose centres lie in the field of one image, IDCS.

    - `ids`
    - `uv_px` (N, 2): images of the centres, which a calibration needs
    - `shadow_px` (N, 2): centroids of the outlines of the shadows, which an image can show; distortion moves them
      outwards, at the rim by 0.02 px (3 mm balls) to 0.07 px (5 mm)
    - `radius_px` (N,)
    - `blur_px` (N,): s.d. of the edge's blur from detector, focal spot at the bead's height, and pixel
    - `contrast` (N,): change of log intensity at the centre without noise, after blur and scatter, against the image
      without sharp objects (negative: dark)
    - `quanta` (N,): counted per pixel at the bead's position, if the bead were not there
    - `gap_px` (N,): from the bead's rim to that of the nearest other sharp object, negative where they overlap
    - `rim_px` (N,): from the bead's rim to the edge of the field, negative where the bead is cut
    - `saturated` (N,): share of pixels within 1.5 radii stored at the white level
    - `exposure`: the image without noise
    """

    ids: tuple[str, ...]
    uv_px: np.ndarray
    shadow_px: np.ndarray
    radius_px: np.ndarray
    blur_px: np.ndarray
    contrast: np.ndarray
    quanta: np.ndarray
    gap_px: np.ndarray
    rim_px: np.ndarray
    saturated: np.ndarray
    exposure: Exposure

    def __len__(self) -> int:
        return len(self.ids)


def hard_scene(
    rng: np.random.Generator,
    dose_class: str,
    frame: Frame | None = None,
    spread: HardScene | None = None,
    *,
    chain: str | None = None,
    even_scatter: bool = True,
    scatter_mm: float = SCATTER_MM,
) -> tuple[Radiograph, BeadTruth]:
    """Draw a hard image of one view, and return it with the truth of its beads.

    The set-up of the frame (default: the Γ frame) has any rotation of the image; the hip has either side, with metal in
    it. `dose_class`: "low", "medium", "high" (`render.DOSES`). `even_scatter`, `scatter_mm`: as in `expose`; the
    defaults give the scenes on which detection was first tuned. Raises SetUpError.
    """
    named(dose_class, DOSES, "dose class", SetUpError)
    return hard_view(rng, frame, spread, chain=chain).exposed(
        rng, dose_class, even_scatter=even_scatter, scatter_mm=scatter_mm
    )


@dataclass(frozen=True, eq=False)
class HardView:
    """A hard scene in one view, before an exposure. `level`: the mean of the image's middle after exposure control."""

    setup: SetUp
    scene: Scene
    projection: Projection
    level: float

    def exposed(
        self,
        rng: np.random.Generator,
        dose_class: str,
        *,
        even_scatter: bool = True,
        scatter_mm: float = SCATTER_MM,
    ) -> tuple[Radiograph, BeadTruth]:
        """Draw its image, and return it with the truth of its beads. Raises SetUpError."""
        dose = replace(named(dose_class, DOSES, "dose class", SetUpError), level=self.level)
        exposure = self.projection.exposed(dose, even_scatter=even_scatter, scatter_mm=scatter_mm)
        image = exposure.read_out(rng)
        return image, bead_truth(self.setup, self.projection.view, self.scene, exposure)


def hard_view(
    rng: np.random.Generator, frame: Frame | None = None, spread: HardScene | None = None, *, chain: str | None = None
) -> HardView:
    """Draw the scene of `hard_scene`, projected once for several doses and scatters. Raises SetUpError."""
    spread, setup = spread or HardScene(), _setup(rng, frame, chain)
    view = setup.views[str(rng.choice(list(setup.views)))]
    scene = _hard_scene(rng, spread, setup)
    level = float(rng.uniform(*spread.level))
    return HardView(setup, scene, project(view, scene), level)


def hard_views(
    rng: np.random.Generator, frame: Frame | None = None, spread: HardScene | None = None, *, chain: str | None = None
) -> dict[str, HardView]:
    """Draw one scene as of `hard_scene` in all views of its set-up, by name, each exposed by itself.

    Raises SetUpError.
    """
    spread, setup = spread or HardScene(), _setup(rng, frame, chain)
    scene = _hard_scene(rng, spread, setup)
    return {
        name: HardView(setup, scene, project(view, scene), float(rng.uniform(*spread.level)))
        for name, view in setup.views.items()
    }


def _setup(rng: np.random.Generator, frame: Frame | None, chain: str | None) -> SetUp:
    return draw_setup(rng, frame or Frame.load("gamma"), side=str(rng.choice(["right", "left"])), chain=chain)


def _hard_scene(rng: np.random.Generator, spread: HardScene, setup: SetUp) -> Scene:
    """Draw the hip with metal in it, in a body of any size."""
    hip = hip_scene(setup, rng).scene
    body, scale = SoftTissue().around(setup.hip_mm), rng.uniform(*spread.tissue_scale)
    half = (body.half_mm[0] * scale, body.half_mm[1] * scale)
    return replace(hip, solids=hip.solids + _metal(rng, spread, setup.hip_mm), tissue=replace(body, half_mm=half))


def bead_truth(setup: SetUp, view: ViewTruth, scene: Scene, exposure: Exposure) -> BeadTruth:
    """Return the truth of the frame's beads in an exposed scene, of all its bodies, for centres in this view's field.

    The true frame's beads must be the first of the scene's solids, as `frame_solids` gives them.
    """
    ids = np.array([b.id for b in setup.true_frame.fiducials])
    shapes = pack(scene.solids)[0]
    places, owner = stations(shapes)
    discs, disc_radius = view.project(places), shadow_radius_px(view, places, shapes[owner, RADIUS])
    centres = shapes[: len(ids), CENTRE]
    uv, radius = view.project(centres), shadow_radius_px(view, centres, shapes[: len(ids), RADIUS])
    seen = np.flatnonzero(view.in_field(uv))
    height = -view.detector.height_mm(view.focal_point_mm)
    depth = height + view.detector.height_mm(centres)
    spot = view.chain.focal_spot_mm * (height / depth - 1) / view.chain.pitch_mm
    mean, without, stored = exposure.mean_pixels(), exposure.open_pixels(), exposure.chain.white
    nearest = np.rint(uv[seen]).astype(int)
    at = (nearest[:, 1], nearest[:, 0])
    return BeadTruth(
        ids=tuple(str(i) for i in ids[seen]),
        uv_px=uv[seen],
        shadow_px=shadow_centres_px(view, centres[seen], shapes[seen, RADIUS]),
        radius_px=radius[seen],
        blur_px=np.sqrt(exposure.core_px**2 + (spot[seen] ** 2 + 1) / 12),
        contrast=np.log(mean[at] - exposure.black) - np.log(without[at] - exposure.black),
        quanta=exposure.open_quanta[at],
        gap_px=np.array(
            [(np.linalg.norm(discs - uv[i], axis=-1) - disc_radius)[owner != i].min() - radius[i] for i in seen]
        ),
        rim_px=view.chain.rim_px(uv[seen]) - radius[seen],
        saturated=np.array([_share(mean >= stored, uv[i], 1.5 * radius[i]) for i in seen]),
        exposure=exposure,
    )


def _metal(rng: np.random.Generator, spread: HardScene, hip_mm: np.ndarray) -> tuple[Solid, ...]:
    """Draw wires, screws and nails around the hip."""

    def count(bounds: tuple[int, int]) -> int:
        return int(rng.integers(bounds[0], bounds[1], endpoint=True))

    def rod(radius_mm: float, half_mm: float, axis: np.ndarray) -> Rod:
        x, y, z = (float(c) for c in hip_mm + rng.uniform(-spread.metal_reach_mm, spread.metal_reach_mm, 3))
        a, b, c = (float(n) for n in axis / np.linalg.norm(axis))
        return Rod((x, y, z), (a, b, c), radius_mm, half_mm)

    wires = [rod(1.25, 100.0, rng.standard_normal(3)) for _ in range(count(spread.wires))]
    screws = [rod(2.25, 20.0, rng.standard_normal(3)) for _ in range(count(spread.screws))]
    nails = [rod(5.5, 90.0, np.array([0.1, 1.0, 0.1]) * rng.standard_normal(3)) for _ in range(count(spread.nails))]
    return (*wires, *screws, *nails)


def _share(mask: np.ndarray, uv_px: np.ndarray, radius_px: float) -> float:
    """Return the share of a disc of pixels where a mask is true."""
    reach = int(radius_px) + 1
    u0, v0 = (max(int(c) - reach, 0) for c in uv_px)
    part = mask[v0 : v0 + 2 * reach + 2, u0 : u0 + 2 * reach + 2]
    u, v = np.arange(part.shape[1]) + u0, np.arange(part.shape[0]) + v0
    return float(part[np.hypot(u - uv_px[0], (v - uv_px[1])[:, None]) <= radius_px].mean())
