"""Scenes for the registration of a bone: a CT scan of it, and two images of it beside beads, with the truth.

Rays are gVirtualXray's through triangle meshes (`benchmarks.gvxr`); nothing of the twin's projector is used. The CT
scan and the meshes have one origin, signed distances from a bone's surface (`surfaces`). The cortex is homogeneous, and
so is the cancellous bone in it. Scan and bone are in patient coordinates; the pose takes these to CFCS.

Images show more of the bone than its scan, which is cropped around the joint.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation
from trimesh.creation import cylinder

import sightline as sl
from benchmarks import gvxr
from benchmarks.gvxr import Parts, above
from benchmarks.scenes.blocks import block
from benchmarks.scenes.surfaces import Anatomy, anatomy
from sightline.calibration import CalibratedView, view_from_matrix
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.imaging.volumes.ct import CFCS_OF_PATIENT, WATER_PER_CM, CtScan
from sightline.studies.scenes import calibrated_views
from sightline.twin import SetUp, ViewTruth
from sightline.twin.xray.distributions import SolidPlace
from sightline.twin.xray.presets import PRESETS, ImageChain
from sightline.twin.xray.render import DOSES
from sightline.twin.xray.setup import Variation, draw_setup
from sightline.twin.xray.tubes import FlatPanel, draw_tube

FIRST_SEED = 35_000  # of the judged scenes; 9000 to 9999 are for development
ANATOMIES, CHAINS = ("femur", "pelvis", "vertebra"), ("panel", "panel low dose", "panel JPEG", "intensifier")
# What is wrong with the scan or the bone, for tests of refusals: the other side's bone, another person's, a scale that
# is 2 % off, a segmentation 0.5 mm too wide, and a part of the bone that has moved by 3 mm.
FAULTS = ("mirrored", "other bone", "scaled", "swollen", "fragment")
OTHER_SIZE, SCALE, SWOLLEN_MM, FRAGMENT_MM = (1.07, 0.94, 1.05), 1.02, 0.5, 3.0
SIDE_PX, PITCH_MM, TUBE_PX = 576, 0.42, 512  # a panel binned to what renders in seconds [ours]
# All that follows [ours]. The block's shadow overlaps that of the bone.
PLACE = SolidPlace((0.0, 44.0, 34.0), 0.45)
TURN_DEG, SHIFT_MM, SIZES = 25.0, 15.0, (0.92, 1.08)  # of the pose, per axis; of the bone, per axis
CORTEX_MM = {"femur": (2.0, 4.0), "pelvis": (1.5, 2.5), "vertebra": (1.0, 2.0)}
HARD, SPONGY = (0.65, 0.85), (0.25, 0.45)  # share of dense bone in the cortex; of that in the cancellous bone
LENGTH_MM, MARGIN_MM, TILT_DEG = (90.0, 140.0), 8.0, 4.0  # of the scan: along the body, around the bone, of its axes
GAIN, TISSUE_HU, NOISE_HU, BLUR_MM = (0.92, 1.08), 40.0, 20.0, 0.5  # the gain is a scanner's calibration error
BODY_MM, FAT_MM = ((120.0, 150.0), (92.0, 112.0)), (6.0, 20.0)  # half axes, lateral and anterior; thickness of the fat
ROD_MM = (6.0, 12.0)  # diameter
PARTNER = {"femur": "pelvis", "pelvis": "femur", "vertebra": "vertebra"}
NEXT_MM = np.array([0.0, 0.0, 39.0])  # from a vertebra to the next
ON_DETECTOR_PX = 12.0  # all targets are seen as far inside the images


@dataclass(frozen=True, eq=False)
class Bone:
    """A drawn bone: its anatomy stretched by `size` (3,) from its joint; thickness of its cortex; `hard`, `spongy`."""

    anatomy: Anatomy
    size: np.ndarray
    cortex_mm: float
    hard: float
    spongy: float

    def stretched(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of the anatomy in this bone."""
        return self.anatomy.joint_mm + self.size * (xyz_mm - self.anatomy.joint_mm)

    def parts(self, label: str, pose: RigidTransform, cut: tuple[np.ndarray, np.ndarray] | None = None) -> Parts:
        """Return the outer and the inner surface of the cortex, CFCS; `cut` as of `Anatomy.surface`."""
        bone, found = self.hard * above("bone"), {}
        for name, level, per_mm in (("outer", 0.0, bone), ("inner", -self.cortex_mm, (self.spongy - 1) * bone)):
            mesh = self.anatomy.surface(level, cut)
            found[f"{label} {name}"] = trimesh.Trimesh(pose.apply(self.stretched(mesh.vertices)), mesh.faces), per_mm
        return found

    def share(self, xyz_mm: np.ndarray, edge_mm: float, swollen_mm: float) -> np.ndarray:
        """Return the share (...) of dense bone in voxels with an edge and middles (..., 3)."""
        at = self.anatomy.at(self.anatomy.joint_mm + (xyz_mm - self.anatomy.joint_mm) / self.size) - swollen_mm
        outer, inner = (np.clip(0.5 - distance / edge_mm, 0.0, 1.0) for distance in (at, at + self.cortex_mm))
        return self.hard * (outer + (self.spongy - 1) * inner)


@dataclass(frozen=True, eq=False)
class BoneScene:
    """A scan and two images of one bone.

    `pose`: patient coordinates to CFCS. `targets_mm` (5, 3): places spread over the bone, patient coordinates.
    `strata`: what was drawn.
    """

    setup: SetUp
    images: dict[str, Radiograph]
    ct: CtScan
    pose: RigidTransform
    targets_mm: np.ndarray
    strata: dict[str, str | float]

    @property
    def true_views(self) -> dict[str, ViewTruth]:
        """The true geometry of the images."""
        return self.setup.views

    @property
    def bone_points_mm(self) -> np.ndarray:
        """Anatomical points (2, 3), patient coordinates."""
        return self.targets_mm[[0, 3]]

    def views(self) -> list[CalibratedView]:
        """Return the views as calibrated from the beads in the images, once.

        Raises what `detect`, `label` and `calibrate` raise.
        """
        return self._calibrated

    def exact_views(self) -> list[CalibratedView]:
        """Return the true views of a panel, without an error. Raises SetUpError for an intensifier, which no matrix
        describes."""
        if self.strata["chain"] == "intensifier":
            raise SetUpError("an intensifier's image is distorted; take the views calibrated from the beads")
        free = np.zeros((12, 12))
        return [view_from_matrix(panel_matrix(view), free, name) for name, view in self.true_views.items()]

    @cached_property
    def _calibrated(self) -> list[CalibratedView]:
        seen = {name: sl.label(sl.detect(image), self.setup.frame, name) for name, image in self.images.items()}
        return calibrated_views(self.setup, seen)


def panel_matrix(view: ViewTruth) -> np.ndarray:
    """Return the matrix (3, 4) that takes CFCS, mm, to the pixels of an undistorted image."""
    focal, plane = view.focal_point_mm, view.detector
    corner, right, down = view.intensifier.to_image(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    to_px = np.vstack([np.column_stack([right - corner, down - corner, corner]), [0.0, 0.0, 1.0]])
    height = plane.normal @ (plane.origin_mm - focal)
    foot_mm = plane.axes @ (focal - plane.origin_mm)
    rays = to_px @ np.vstack([height * plane.axes + np.outer(foot_mm, plane.normal), plane.normal])
    return np.column_stack([rays, -rays @ focal])


def draw_bone_scene(
    seed: int,
    *,
    anatomy_name: str | None = None,
    chain: str | None = None,
    overlap: bool | None = None,
    metal: bool | None = None,
    fault: str | None = None,
    voxel_mm: float = 1.0,
) -> BoneScene:
    """Return the scene of a seed. What is None is drawn: anatomy and chain evenly, an overlap in half of the scenes,
    metal in a third. The images do not depend on `voxel_mm`, nor on a `fault` of the scan.

    Raises SetUpError if the femur's mesh or gVirtualXray is not there, or no set-up shows all targets.
    """
    if not gvxr.INSTALLED:
        raise SetUpError("gVirtualXray is not installed; pip install gvxr")
    rng = np.random.default_rng([17, seed])
    drawn = (rng.choice(ANATOMIES), rng.choice(CHAINS), rng.random() < 1 / 2, rng.random() < 1 / 3)
    given = (anatomy_name, chain, overlap, metal)
    kind, chain, overlap, metal = (own if asked is None else asked for own, asked in zip(drawn, given, strict=True))
    bone = _drawn(rng, str(kind))
    targets = bone.stretched(np.array(list(bone.anatomy.points_mm.values())))
    setup, pose = _shown(rng, str(chain), targets)
    optics = next(iter(setup.views.values())).chain
    quanta = DOSES["low" if chain == "panel low dose" else "medium"].quanta(optics)
    parts = _around(rng, setup, pose.apply(targets.mean(axis=0)), metal=bool(metal))
    if overlap:
        partner = _drawn(rng, PARTNER[bone.anatomy.name])
        at = bone.anatomy.joint_mm + (NEXT_MM if bone.anatomy.name == "vertebra" else 0.0)
        parts |= partner.parts("partner", _turned(rng, 6.0, pose.rotation, partner.anatomy.joint_mm, pose.apply(at)))
    parts |= _fractured(rng, bone, pose) if fault == "fragment" else bone.parts("bone", pose)
    draw = gvxr.intensifier_image if chain == "intensifier" else gvxr.panel_image
    images = {name: draw(view, parts, rng, quanta) for name, view in setup.views.items()}
    if chain == "panel JPEG":
        images = {name: exported(image) for name, image in images.items()}
    ct = scanned(bone, np.random.default_rng([17, seed, 1]), fault, voxel_mm)
    strata = {"anatomy": str(kind), "chain": str(chain), "overlap": bool(overlap), "metal": bool(metal)}
    strata |= {"fault": fault or "none", "cortex_mm": bone.cortex_mm, "spongy": bone.spongy, "voxel_mm": voxel_mm}
    return BoneScene(setup, images, ct, pose, targets, strata)


def _drawn(rng: np.random.Generator, name: str) -> Bone:
    size, cortex = rng.uniform(*SIZES, 3), rng.uniform(*CORTEX_MM[name])
    return Bone(anatomy(name), size, cortex, rng.uniform(*HARD), rng.uniform(*SPONGY))


def _shown(rng: np.random.Generator, chain: str, targets_mm: np.ndarray) -> tuple[SetUp, RigidTransform]:
    """Draw a set-up and the pose of a bone whose targets (5, 3) both images show. Raises SetUpError."""
    middle, standard = targets_mm.mean(axis=0), Rotation.from_matrix(CFCS_OF_PATIENT["left"])
    for _ in range(200):
        setup = _setup(rng, chain)
        at = setup.hip_mm + rng.uniform(-SHIFT_MM, SHIFT_MM, 3)
        turn = Rotation.from_euler("xyz", rng.uniform(-TURN_DEG, TURN_DEG, 3), degrees=True)
        pose = _about(turn * standard, middle, at)
        if setup.shows(pose.apply(targets_mm), ON_DETECTOR_PX):
            return setup, pose
    raise SetUpError("none of 200 set-ups shows all targets of the bone in both images; draw another seed")


def _setup(rng: np.random.Generator, chain: str) -> SetUp:
    if chain == "intensifier":
        optics = _sized(PRESETS["9in-1k"], TUBE_PX, PRESETS["9in-1k"].field_mm)
        return draw_setup(
            rng,
            Frame.load("gamma"),
            side="left",
            variation=Variation(tube=draw_tube(rng, optics, Variation().distortion)),
        )
    panel = FlatPanel(_sized(PRESETS["flat-panel"], SIDE_PX, SIDE_PX * PITCH_MM))
    return draw_setup(rng, block(0.02), side="left", variation=Variation(tube=panel, place=PLACE))


def _sized(chain: ImageChain, side_px: int, field_mm: float) -> ImageChain:
    share = side_px / chain.shape[0]
    return replace(chain, shape=(side_px, side_px), mask_px=chain.mask_px * share, field_mm=field_mm)


def _about(rotation: Rotation, point_mm: np.ndarray, at_mm: np.ndarray) -> RigidTransform:
    """Return the transform with a rotation that takes one point (3,) to another."""
    return RigidTransform.from_components(at_mm - rotation.apply(point_mm), rotation)


def _turned(
    rng: np.random.Generator, sd_deg: float, rotation: Rotation, point_mm: np.ndarray, at_mm: np.ndarray
) -> RigidTransform:
    return _about(Rotation.from_rotvec(np.radians(sd_deg) * rng.standard_normal(3)) * rotation, point_mm, at_mm)


def _around(rng: np.random.Generator, setup: SetUp, at_mm: np.ndarray, *, metal: bool) -> Parts:
    """Return the frame, the body with its layer of fat, and a rod of steel before or behind the bone at (3,)."""
    half, fat = np.array([rng.uniform(*axis) for axis in BODY_MM]), rng.uniform(*FAT_MM)
    middle = at_mm + rng.uniform(-12.0, 12.0, 3)
    parts = {
        **gvxr.frame_parts(setup.true_frame),
        "body": (gvxr.ellipse(tuple(half), 500.0, middle), gvxr.PER_MM["fat"]),
        "flesh": (gvxr.ellipse(tuple(half - fat), 500.0, middle), above("tissue", "fat")),
    }
    if metal:
        off = rng.uniform(-20.0, 20.0, 3) + rng.choice([-1.0, 1.0]) * np.array([0.0, 0.0, 38.0])
        along = rng.standard_normal(3) * [1.0, 1.0, 0.3]
        ends = at_mm + off + np.outer([-60.0, 60.0], along / np.linalg.norm(along))
        parts["rod"] = (cylinder(rng.uniform(*ROD_MM) / 2, segment=ends, sections=64), above("steel"))
    return parts


def _fractured(rng: np.random.Generator, bone: Bone, pose: RigidTransform) -> Parts:
    """Return the two parts of a bone, the lower of which has moved by FRAGMENT_MM."""
    at, down = np.mean(list(bone.anatomy.points_mm.values()), axis=0), np.array([0.2, 0.1, -1.0]) / np.sqrt(1.05)
    off = rng.standard_normal(3)
    moved = RigidTransform.from_translation(FRAGMENT_MM * off / np.linalg.norm(off)) * pose
    return {**bone.parts("bone", pose, (at, down)), **bone.parts("fragment", moved, (at, -down))}


def exported(image: Radiograph) -> Radiograph:
    """Return an image as an archive exports it: 8 bits, JPEG of quality 80."""
    top = float(np.percentile(image.pixels, 99.5))
    eight = np.clip(np.rint(image.pixels * (250.0 / top)), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", eight, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return Radiograph(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), 255.0, lossy=True)


def scanned(bone: Bone, rng: np.random.Generator, fault: str | None = None, voxel_mm: float = 1.0) -> CtScan:
    """Return the scan of a bone in soft tissue, with blur and noise, on a grid of its own, cropped around its joint."""
    if fault == "other bone":
        bone = replace(bone, size=bone.size * OTHER_SIZE)
    points, joint = bone.stretched(bone.anatomy.surface(0.0).vertices), bone.anatomy.joint_mm
    length = rng.uniform(*LENGTH_MM)
    top = min(points[:, 2].max() + MARGIN_MM, joint[2] + length / 2)
    points = points[(points[:, 2] < top) & (points[:, 2] > top - length)]
    low = points.min(axis=0) - MARGIN_MM + rng.uniform(0.0, voxel_mm, 3)
    high = points.max(axis=0) + MARGIN_MM
    low[2], high[2] = top - length, top
    shape = np.ceil((high - low) / voxel_mm).astype(int)
    axes = Rotation.from_euler("xyz", rng.uniform(-TILT_DEG, TILT_DEG, 3), degrees=True).as_matrix()
    steps = voxel_mm * (np.moveaxis(np.indices(shape), 0, -1) - (shape - 1) / 2)
    share = bone.share((low + high) / 2 + steps @ axes, voxel_mm, SWOLLEN_MM if fault == "swollen" else 0.0)
    gain, per_share = rng.uniform(*GAIN), float(above("bone")[1:3].mean())  # 60 keV lies between the two
    hu = TISSUE_HU + gain * 1000.0 * gaussian_filter(share, BLUR_MM / voxel_mm) * per_share / (WATER_PER_CM / 10)
    hu = np.rint(hu + NOISE_HU * rng.standard_normal(hu.shape)).astype(np.int16)
    origin = (low + high) / 2 - voxel_mm * (shape - 1) / 2 @ axes
    stretch = SCALE if fault == "scaled" else 1.0
    return CtScan(hu[::-1] if fault == "mirrored" else hu, origin, np.full(3, voxel_mm * stretch), axes)
