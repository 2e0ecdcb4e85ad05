"""The C-arm in its two poses: true positions of source and detector, and true projection of points to pixels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import pi

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.outlines import centroids
from sightline.common.geometry.planes import Plane
from sightline.errors import OutsideRegionError, SetUpError
from sightline.frame import Fiducial, Frame, RigidBody
from sightline.frame.tolerances import DRAPE_N, EXPANSION_PER_K, MOISTURE_EXPANSION
from sightline.twin.xray.distributions import (
    NEAR_PLACE,
    Arm,
    Distortion,
    IndependentViews,
    PlateMount,
    Pose,
    SolidPlace,
    Stance,
    beam_at,
    draw_arm,
)
from sightline.twin.xray.intensifier import Intensifier
from sightline.twin.xray.presets import ImageChain, preset
from sightline.twin.xray.tubes import FlatPanel, Site, Tube, draw_earth, draw_tube, field_at

ATTEMPTS = 100
CLEAR_PX = 1.0  # [ours] between shadows that are both measured: with less, blur joins them
BEAMS = {"pa": beam_at(0.0), "lateral": beam_at(pi / 2), "oblique": beam_at(pi / 4)}
SOLID_VIEWS = ("pa", "lateral")  # of a solid, by default


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """The true geometry of one view, CFCS. `detector`: the input plane, with axes along u and v of an undistorted image
    as seen from the X-ray source (axes[0] x axes[1] points along the beam); detection calls this not mirrored."""

    name: str
    focal_point_mm: np.ndarray
    detector: Plane
    intensifier: Intensifier

    @property
    def chain(self) -> ImageChain:
        """The image chain."""
        return self.intensifier.chain

    def to_detector(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Project points (..., 3) onto the input plane: detector coordinates (..., 2), mm.

        Raises OutsideRegionError for a point that is not in front of the source.
        """
        height = self.detector.height_mm(self.focal_point_mm)
        if not (self.detector.height_mm(xyz_mm) > height).all():
            raise OutsideRegionError("a point lies behind the X-ray source or is not finite")
        return self.detector.central_projection(self.focal_point_mm, xyz_mm)

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Project points (..., 3), CFCS, to true pixels (..., 2), in the field or not. Raises OutsideRegionError."""
        return self.intensifier.to_image(self.to_detector(xyz_mm))

    def in_field(self, uv_px: np.ndarray, margin_px: float | np.ndarray = 0.0) -> np.ndarray:
        """Whether pixels (..., 2) lie at least `margin_px` inside the field: bool (...,)."""
        return self.intensifier.in_field(uv_px, margin_px)

    def points_on_detector(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the points (..., 3), CFCS, where rays of pixels meet the input plane. Raises OutsideRegionError."""
        return self.detector.to_space(self.intensifier.to_detector(uv_px))

    def beyond_cubic_factor(self, uv_px: np.ndarray) -> np.ndarray:
        """Return a factor (2N, P), px; see `Intensifier.beyond_cubic_factor`."""
        return self.intensifier.beyond_cubic_factor(uv_px)

    def beyond_cubic_covariance(self, uv_px: np.ndarray) -> np.ndarray:
        """Return a covariance (2N, 2N), px², in the order u1, v1, u2, ...; see `Intensifier.beyond_cubic_factor`."""
        return self.intensifier.beyond_cubic_covariance(uv_px)


@dataclass(frozen=True, eq=False)
class SetUp:
    """A frame in front of a C-arm, with its views.

    `frame`: the nominal frame, known to the software; `true_frame`: the frame with its errors. `side`: of the hip.
    `tube`: the C-arm's detector, before an exposure. `hip_mm` (3,): where a hip lies, CFCS: at the origin between
    plates, beside a solid. `mount`: takes the coordinates of the frame's plate on the detector to the detector's: its
    axis u, against its axis v, against the beam.
    """

    frame: Frame
    true_frame: Frame
    views: dict[str, ViewTruth]
    side: str
    tube: Tube | FlatPanel
    hip_mm: np.ndarray = field(default_factory=lambda: np.zeros(3))
    mount: RigidTransform = field(default_factory=RigidTransform.identity)

    def renamed(self, names: Sequence[str]) -> "SetUp":
        """Return the set-up with these names of its views, in their order."""
        views = {name: replace(view, name=name) for name, view in zip(names, self.views.values(), strict=True)}
        return replace(self, views=views)

    def frame_in(self, view: str) -> Frame:
        """Return the true frame at the exposure of a view, with the plate on the detector placed in CFCS."""
        frame = self.true_frame
        if frame.solid is None or frame.detector is None:
            return frame
        return frame.with_beads_at(
            np.concatenate([frame.solid.xyz_mm, self.T_cfcs_plate(view).apply(frame.detector.xyz_mm)])
        )

    def shows(self, points_mm: np.ndarray, margin_px: float) -> bool:
        """Return whether all points (N, 3), CFCS, lie at least `margin_px` inside the field of every view."""
        return all(view.in_field(view.project(points_mm), margin_px).all() for view in self.views.values())

    def T_cfcs_plate(self, view: str) -> RigidTransform:
        """Return the pose of the plate on the detector at the exposure of a view."""
        detector = self.views[view].detector
        to_cfcs = Rotation.from_matrix(detector.basis.T * [1.0, -1.0, -1.0])
        return RigidTransform.from_components(detector.origin_mm, to_cfcs) * self.mount


@dataclass(frozen=True)
class Variation:
    """The distributions that set-ups are drawn from.

    `site`: a given magnetic field, including stray fields, instead of a drawn one. `arm`: views of one arm that orbits
    and sags, instead of independent views; `Pose.orbit` is then not used. `tube`: a given detector instead of a drawn
    one. `place`: of the hip beside a solid; None: as the chain's field allows. `mount`: of a plate on the detector.
    """

    pose: Pose = field(default_factory=Pose)
    distortion: Distortion = field(default_factory=Distortion)
    site: Site | None = None
    arm: Arm | None = None
    tube: Tube | FlatPanel | None = None
    place: SolidPlace | None = None
    mount: PlateMount = field(default_factory=PlateMount)


def chain_for(frame: Frame) -> str:
    """Return the name of the image chain of a frame: an intensifier before plates, a flat panel before a solid."""
    return "flat-panel" if frame.solid is not None and frame.detector is None else "9in-1k"


def hip_of(frame: Frame, side: str) -> np.ndarray:
    """Return where a hip lies by default, (3,), CFCS: `SetUp.hip_mm`."""
    return _hip_and_aim(frame, side, SolidPlace())[0]


def draw_setup(
    rng: np.random.Generator,
    frame: Frame,
    *,
    side: str = "right",
    frame_errors: bool = True,
    chain: str | None = None,
    variation: Variation | None = None,
    views: Mapping[str, np.ndarray] | None = None,
) -> SetUp:
    """Draw a set-up of a frame: poses and distortions of its views, and the frame's errors.

    `chain`: name of the image chain; default: `chain_for(frame)`. `views`: nominal beams (3,), CFCS, of the images of a
    solid, by name; default: SOLID_VIEWS of BEAMS. The views of plates are their own.

    Frame errors are drawn from the frame's effective tolerances; for other tolerances pass
    `dataclasses.replace(frame, tolerances=...)`, for none `frame_errors=False`. Poses with too few beads in the field
    (of a solid: any bead outside it) are drawn again. Raises SetUpError if no pose has enough, and for a solid in front
    of an intensifier, whose distortion it cannot show.
    """
    if side not in ("right", "left"):
        raise SetUpError(f"a hip's side is 'right' or 'left', not {side!r}")
    variation = variation or Variation()
    true_frame = with_errors(frame, rng) if frame_errors else frame
    pose, optics = variation.pose, preset(chain or chain_for(frame))
    if frame.solid is not None:
        pose = replace(pose, detector_tilt=pose.panel_tilt)
    place = variation.place or (SolidPlace() if optics.tube_mm is None else NEAR_PLACE)
    beams, hip, aim = _beams(frame, optics, views), *_hip_and_aim(frame, side, place)
    earth = draw_earth(rng, variation.distortion)
    tube = variation.tube or draw_tube(rng, optics, variation.distortion)
    stance = IndependentViews(pose) if variation.arm is None else draw_arm(rng, variation.arm, pose)
    caudal = np.array([0.0, 1.0 if side == "right" else -1.0, 0.0])
    for _ in range(ATTEMPTS):
        tilt = Rotation.from_rotvec(rng.normal(0.0, pose.frame_tilt, 3)).as_matrix()
        stands = {
            name: _draw_stand(rng, np.stack([beam, caudal, aim]), tilt, pose, (stance, optics.sdd_mm))
            for name, beam in beams.items()
        }
        if any(stand is None for stand in stands.values()):
            continue
        stood = {}
        for name, stand in stands.items():
            if stand is not None:
                magnet = earth if variation.site is None else field_at(variation.site, stand[1].origin_mm)
                stood[name] = ViewTruth(name, *stand, tube.expose(rng, stand[1].basis, magnet))
        if all(_enough_in_field(view, true_frame, pose) for view in stood.values()):
            mount = _mounted(rng, variation.mount) if frame.detector is not None else RigidTransform.identity()
            return SetUp(frame, true_frame, stood, side, tube, hip, mount)
    enough = f"{pose.beads_in_field:.0%} of the beads of each plate" if frame.solid is None else "all beads"
    raise SetUpError(
        f"none of {ATTEMPTS} poses brings {enough} of frame {frame.name!r} into the field: make it smaller, or reduce "
        "the C-arm's variation or its distance from the hip"
    )


def bead_images(
    setup: SetUp, view: str, rng: np.random.Generator, sd_px: float = 0.1
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return ids and measured pixels (N, 2) of the true frame's beads whose whole shadow lies in the field of a view.

    The pixels have independent normal errors of `sd_px` per coordinate. They are the images of the centres; of a solid
    the centroids of the shadows, up to 0.012 px from these, for which its calibration allows. Before a plate on the
    detector those that touch are left out.
    """
    truth, beads = setup.views[view], setup.frame_in(view).fiducials_of(view)
    uv, inside = _beads_in_field(truth, beads)
    if setup.true_frame.solid is not None:
        xyz, radius = (np.array([getattr(bead, name) for bead in beads]) for name in ("xyz_mm", "diameter_mm"))
        uv = shadow_centres_px(truth, xyz, radius / 2)
        if setup.frame.detector is not None:
            inside &= _clear(
                uv, shadow_radius_px(truth, xyz, radius / 2), np.isin([b.id for b in beads], setup.frame.detector.ids)
            )
    ids = tuple(bead.id for bead, kept in zip(beads, inside, strict=True) if kept)
    return ids, uv[inside] + sd_px * rng.standard_normal((len(ids), 2))


def _clear(uv_px: np.ndarray, radius_px: np.ndarray, on_plate: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which shadows touch none of the other body, plate or solid."""
    apart = np.linalg.norm(uv_px[:, None] - uv_px, axis=2) - radius_px[:, None] - radius_px
    apart[on_plate[:, None] == on_plate] = np.inf
    return apart.min(axis=1) > CLEAR_PX


def _mounted(rng: np.random.Generator, spread: PlateMount) -> RigidTransform:
    """Draw how a plate is put on the detector."""
    turn = Rotation.from_rotvec(np.array([spread.tilt, spread.tilt, spread.turn]) * rng.standard_normal(3))
    sd = np.array([spread.shift_mm, spread.shift_mm, spread.stand_off_mm])
    return RigidTransform.from_components(sd * rng.standard_normal(3), turn)


def shadow_radius_px(view: ViewTruth, xyz_mm: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """Return the radii (N,), px, of the shadows of balls at (N, 3), to first order, from the mean magnification."""
    depth = view.detector.height_mm(view.focal_point_mm) - view.detector.height_mm(xyz_mm)
    magnification = view.detector.height_mm(view.focal_point_mm) / depth
    local = np.linalg.det(view.intensifier.jacobian(view.to_detector(xyz_mm)))
    return radius_mm * magnification * np.sqrt(np.abs(local))


def shadow_centres_px(view: ViewTruth, xyz_mm: np.ndarray, radius_mm: np.ndarray, around: int = 48) -> np.ndarray:
    """Return the centroids (N, 2), px, of the outlines of the shadows of balls at (N, 3) of the radii (N,).

    A fit to the image can find this centroid. Distortion bends a shadow, so it is not the image of the ball's centre.
    """
    towards = xyz_mm - view.focal_point_mm
    distance = np.linalg.norm(towards, axis=-1)[:, None]
    across = np.linalg.svd(towards[:, None, :])[2][:, 1:]
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ across  # (N, around, 3)
    rim = radius_mm[:, None, None] / np.sqrt(1 - (radius_mm[:, None, None] / distance[..., None]) ** 2)
    return centroids(view.project(xyz_mm[:, None, :] + rim * ring))


def with_errors(frame: Frame, rng: np.random.Generator) -> Frame:
    """Draw the frame as manufactured: its beads are displaced by `frame.error_factor @ N(0, 1)`."""
    factor = frame.error_factor
    return displaced(frame, (factor @ rng.standard_normal(factor.shape[1])).reshape(-1, 3))


def displaced(frame: Frame, moves_mm: np.ndarray) -> Frame:
    """Return the frame with its beads moved by (M, 3) mm, in the order of `Frame.error_factor`."""
    return frame.with_beads_at(frame.xyz_mm + moves_mm)


def _beams(frame: Frame, optics: ImageChain, views: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray]:
    """Return the nominal beams (3,) of the views. Raises SetUpError."""
    if frame.solid is None:
        if views is not None:
            raise SetUpError(f"the beams of frame {frame.name!r} are those of its plates; give views only for a solid")
        return {name: view.axis for name, view in frame.views.items()}
    if optics.tube_mm is not None and frame.detector is None:
        raise SetUpError(
            f"the beads of {frame.name!r} alone cannot show the distortion of the intensifier of {optics.name!r}; use "
            "the chain 'flat-panel', or a plate on the detector ('block30+detector-plate')"
        )
    chosen = {name: BEAMS[name] for name in SOLID_VIEWS} if views is None else views
    beams = {name: np.asarray(beam, dtype=np.float64) for name, beam in chosen.items()}
    if not beams or not all(b.shape == (3,) and 0 < np.linalg.norm(b) < np.inf for b in beams.values()):
        raise SetUpError("give each view of a solid by its name and a beam: three finite numbers, not all zero")
    return {name: beam / np.linalg.norm(beam) for name, beam in beams.items()}


def _hip_and_aim(frame: Frame, side: str, place: SolidPlace) -> tuple[np.ndarray, np.ndarray]:
    """Return where the hip lies and where the beams are aimed, (3,) each, CFCS."""
    if frame.solid is None:
        return np.zeros(3), np.zeros(3)
    xyz, (lateral, caudal, anterior) = frame.solid.xyz_mm, place.solid_mm
    to_solid = np.array([lateral, caudal if side == "right" else -caudal, anterior])
    hip = (xyz.min(axis=0) + xyz.max(axis=0)) / 2 - to_solid
    return hip, hip + place.aim * to_solid


Stand = tuple[np.ndarray, Plane]


def _draw_stand(
    rng: np.random.Generator, intended: np.ndarray, frame_tilt: np.ndarray, pose: Pose, arm: tuple[Stance, float]
) -> Stand | None:
    """Draw the focal point and detector plane of one view; None if its beam is tilted beyond the limit.

    `intended` (3, 3): the view's nominal beam, the direction that points down in its image, and the point that it is
    aimed at, CFCS. `frame_tilt` (3, 3): rotation of the frame. `arm`: the distribution of its stance, and its
    distance from source to detector if rigid.
    """
    stance, sdd_mm = arm
    swing = stance.swing(rng, frame_tilt @ intended[0])
    if swing is None:
        return None
    beam, down = intended[:2] @ (swing @ frame_tilt).T
    if beam @ intended[0] < np.cos(pose.tilt_limit):
        return None
    axes = _detector_axes(beam, down, rng.uniform(-pose.in_plane, pose.in_plane))
    middle = intended[2] + rng.uniform(-pose.hip_offset_mm, pose.hip_offset_mm, 2) @ axes
    focal = middle - pose.source_to_hip_mm * beam
    sag = stance.sag(rng, beam, axes)
    centre = focal + (sdd_mm + sag.longer_mm) * beam + sag.shift_mm
    return focal, Plane(centre, axes @ Rotation.from_rotvec(sag.rotation).as_matrix().T)


def _detector_axes(beam: np.ndarray, down: np.ndarray, angle: float) -> np.ndarray:
    """Return u and v (2, 3) of an image seen from the source; `down` points down before the image is rotated."""
    v = down - (down @ beam) * beam
    norm = np.linalg.norm(v)
    if norm < 0.1:
        raise SetUpError("a view's beam runs along the body; the twin has no such view")
    v /= norm
    u = np.cross(v, beam)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * u + s * v, -s * u + c * v])


def _beads_in_field(truth: ViewTruth, beads: tuple[Fiducial, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of beads, and whether each lies entirely in the field (N,)."""
    xyz = np.array([bead.xyz_mm for bead in beads])
    radius = shadow_radius_px(truth, xyz, np.array([bead.diameter_mm / 2 for bead in beads]))
    uv = truth.project(xyz)
    return uv, truth.in_field(uv, radius)


def _enough_in_field(truth: ViewTruth, frame: Frame, pose: Pose) -> bool:
    if frame.solid is not None:
        return bool(_beads_in_field(truth, frame.solid.fiducials)[1].all())
    view = frame.view(truth.name)
    return all(
        _beads_in_field(truth, plate.fiducials)[1].mean() >= pose.beads_in_field for plate in (view.xrii, view.source)
    )


DOWN = np.array([0.0, 0.0, -1.0])  # the patient lies supine: +Z is up


@dataclass(frozen=True)
class Handling:
    """Change since the frame was measured: temperature, K; absorbed water, share of mass; load per arm, N."""

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0

    def __post_init__(self) -> None:
        if not (-100 < self.warmer_k < 100 and -0.03 < self.water_share < 0.03 and 0 <= self.drape_n < 1000):
            raise SetUpError(f"a frame of PMMA cannot be used so: {self}; give values within -100 to 100 K, 3 %, 1 kN")


def in_use(frame: Frame, handling: Handling) -> Frame:
    """Return the frame as it is in use, with its handling errors.

    Heat and moisture expand each plate, or the solid, about its centre. Each DRAPE_N of load lowers and tilts a plate
    by a plate tolerance (about Y, the same for the arms of both sides). The metal arms keep their length. A solid does
    not bend.
    """
    stretch = EXPANSION_PER_K * handling.warmer_k + MOISTURE_EXPANSION * handling.water_share
    tolerance, load = frame.effective_tolerances, handling.drape_n / DRAPE_N if frame.solid is None else 0.0
    sag, tilt = load * tolerance.plate_mm * DOWN, load * tolerance.plate_rad * np.array([0.0, 1.0, 0.0])

    def move(body: RigidBody) -> np.ndarray:
        centred = body.xyz_mm - body.xyz_mm.mean(axis=0)
        return stretch * centred + np.cross(tilt, centred) + sag

    return displaced(frame, np.concatenate([move(body) for body in frame.bodies]))
