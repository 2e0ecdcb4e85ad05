"""Trials of registration for `bench_bone`: scenes of bones, each registered in several ways, and bones with a fault."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.harness import mahalanobis2
from benchmarks.scenes.bones import FAULTS, FIRST_SEED, BoneScene, draw_bone_scene
from sightline.calibration import CalibratedView, view_from_matrix
from sightline.common.geometry.lines import across, unit
from sightline.errors import SightlineError
from sightline.from_images.ct_wire import ct_wire
from sightline.from_images.registration import BonePose, BoneStart, ScannedBone, register_bone
from sightline.from_images.registration.align import moved
from sightline.from_images.registration.clicks import start_of_clicks
from sightline.imaging import Radiograph
from sightline.imaging.volumes import CtScan
from sightline.planning import kind

FAULT_SEED, MOVED_SEED = FIRST_SEED + 5000, FIRST_SEED + 6000
# Of so many scenes one is registered without a start, which takes as long as fifteen with one; with a CT of 2 mm.
NO_START_EVERY, COARSE_EVERY = 12, 3
REACH = {"near": 10.0, "wide": 20.0}  # of a start: mm and degrees along each axis
MOVED_MM = 4.0  # of the bone between the two images
CLICK_PX, CLICK_MM = 1.0, 2.0  # s.d. of a person's click: from a pixel to so far at the bone [ours]
# Of movements between the images: the axes of `beam_axes` along and about which they go, and their sizes, mm and °.
WAYS = ("last beam", "first beam, across the last", "across both beams")
SIZES = (0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0)
# Movements that matter and that images hardly show: mm along, and ° about, an axis at random across the last beam; mm
# along the last beam.
HIDDEN = {"1 mm across the last beam": (0.0, 1.0, 0.0), "0.5° about an axis across the last beam": (0.5, 0.0, 0.0),
          "3 mm along the last beam": (0.0, 0.0, 3.0)}  # fmt: skip
HEAD_FIELD_MM = 35.0  # radius of the field around the head, which has 23 mm [ours]
Record = dict[str, Any]


def right_trial(k: int) -> dict[str, Record]:
    """Return what each way of registering the bone of scene `k` gave, and the scene's strata."""
    scene, rng = draw_bone_scene(FIRST_SEED + k), np.random.default_rng([FIRST_SEED, k])
    bone, images, views = ScannedBone.of_ct(scene.ct), list(scene.images.values()), scene.views()
    near, wide = (start_off(scene, bone, rng, reach) for reach in REACH.values())
    ways: dict[str, Any] = {
        "own": (bone, images, views, near),
        "wide": (bone, images, views, wide),
    }
    searched = k % NO_START_EVERY == 0
    if searched:
        ways["none"] = bone, images, views, None
    if scene.strata["chain"] != "intensifier":
        exact = scene.exact_views()
        ways["exact"] = bone, images, exact, near
        if searched:
            ways["none exact"] = bone, images, exact, None
        if k % COARSE_EVERY == 0:
            ways["2 mm"] = ScannedBone.of_ct(halved(scene.ct)), images, exact, near
        if scene.strata["anatomy"] == "femur":
            ways["head"] = bone, head_alone(scene), exact, near
    ways["clicks"] = bone, images, views, partial(clicked, scene, views, rng)
    return {"strata": scene.strata} | {way: registered(scene, *given) for way, given in ways.items()}


def start_off(scene: BoneScene, bone: ScannedBone, rng: np.random.Generator, reach: float) -> BoneStart:
    """Return a start that is off by up to `reach`, mm and degrees, along each axis."""
    centre, shift = scene.pose.apply(bone.centre_mm), rng.uniform(-reach, reach, 3)
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-reach, reach, 3)))
    off = RigidTransform.from_components(centre + shift - turn.apply(centre), turn)
    return BoneStart(off * scene.pose, reach, np.deg2rad(reach))


def clicked(scene: BoneScene, views: Sequence[CalibratedView], rng: np.random.Generator) -> BoneStart:
    """Return the start of two anatomical points that a person clicked in both images."""
    points, clicks = dict(zip("ab", scene.bone_points_mm, strict=True)), {"a": {}, "b": {}}
    share = rng.uniform()
    for name, view in scene.true_views.items():
        at = scene.pose.apply(scene.bone_points_mm)
        exact, beside = view.project(at), view.project(at + CLICK_MM * view.detector.axes[0])
        largest = np.linalg.norm(beside - exact, axis=1).mean()
        noisy = exact + (CLICK_PX + share * (largest - CLICK_PX)) * rng.standard_normal((2, 2))
        clicks["a"][name], clicks["b"][name] = noisy
    return start_of_clicks(points, clicks, views)


def halved(ct: CtScan) -> CtScan:
    """Return a scan with the means of 2 x 2 x 2 voxels."""
    counts = np.array(ct.hu.shape) // 2
    blocks = ct.hu[tuple(slice(2 * n) for n in counts)].reshape(np.column_stack([counts, [2, 2, 2]]).ravel())
    hu = np.rint(blocks.mean(axis=(1, 3, 5))).astype(np.int16)
    return CtScan(hu, ct.origin_mm + (ct.voxel_mm / 2) @ ct.axes, 2 * ct.voxel_mm, ct.axes)


def head_alone(scene: BoneScene) -> list[Radiograph]:
    """Return the images with a round field about the bone's joint."""
    shown, joint = [], scene.pose.apply(scene.targets_mm[0])
    for name, image in scene.images.items():
        view = scene.true_views[name]
        middle, rim = view.project(np.array([joint, joint + HEAD_FIELD_MM * view.detector.axes[0]]))
        rows, columns = np.indices(image.shape)
        outside = np.hypot(columns - middle[0], rows - middle[1]) > np.linalg.norm(rim - middle)
        shown.append(replace(image, pixels=np.where(outside, 0, image.pixels).astype(image.pixels.dtype)))
    return shown


def registered(
    scene: BoneScene,
    bone: ScannedBone,
    images: Sequence[Radiograph],
    views: Sequence[CalibratedView],
    start: BoneStart | Callable[[], BoneStart] | None,
) -> Record:
    """Return errors of a pose: `error_mm` mean of the targets, `turn_deg`, squared lengths over the stated error of the
    pose and of the targets; whether it is trusted, and the failed checks; `along_beams`. "said": why there is none."""
    try:
        found = register_bone(bone, images, views, start() if callable(start) else start)
    except SightlineError as refusal:
        return {"said": str(refusal), "error_mm": np.inf, "trusted": False}
    off = scene.pose.apply(scene.targets_mm) - found.at(scene.targets_mm)
    change = scene.pose * found.pose.inv()
    step = np.concatenate([change.rotation.as_rotvec(), change.apply(found.centre_mm) - found.centre_mm])
    by_target = np.array([found.covariance_at(target[None]) for target in scene.targets_mm])
    wire = ct_wire(found, scene.bone_points_mm, kind("free-wire"))
    ends = wire.trajectory.points
    return {
        "error_mm": float(np.linalg.norm(off, axis=1).mean()),
        "turn_deg": float(np.rad2deg(change.rotation.magnitude())),
        "pose2": float(mahalanobis2(step, found.covariance)),
        "targets2": mahalanobis2(off, by_target),
        "go": wire.verdict.go,
        "wire2": mahalanobis2(ends.xyz_mm - scene.pose.apply(scene.bone_points_mm), ends.covariance_mm2),
        "trusted": found.trusted,
        "failed": [check.name for check in found.checks if not check.passed],
        "alone": along_beams(scene, found),
    }


def along_beams(scene: BoneScene, found: BonePose) -> np.ndarray:
    """Return of each view's own pose (V, 2) the error at the bone's centre along its beam, and its stated bound, mm."""
    centre = found.bone.centre_mm
    truth, rows = scene.pose.apply(centre), []
    for view in found.views:
        beam = truth - view.focal_point_mm
        off = RigidTransform.from_matrix(view.own_matrix).apply(centre) - truth
        rows.append([abs(off @ beam) / np.linalg.norm(beam), view.along_beam_95_mm])
    return np.array(rows, dtype=np.float64)


def fault_trial(k: int) -> Record:
    """Return what a scan or a bone with a fault gave with exact views; by turns one fault, or a bone that moved."""
    fault = (*FAULTS, "moved")[k % (len(FAULTS) + 1)]
    sided = ("femur", "pelvis")[k // 2 % 2] if fault == "mirrored" else None  # a vertebra has no other side
    scene = draw_bone_scene(
        FAULT_SEED + k, anatomy_name=sided, chain="panel", fault=None if fault == "moved" else fault
    )
    rng, bone, views = np.random.default_rng([FAULT_SEED, k]), ScannedBone.of_ct(scene.ct), scene.exact_views()
    if fault == "moved":
        way = rng.standard_normal(3)
        views[1] = seen_moved(views[1], RigidTransform.from_translation(MOVED_MM * unit(way)))
    start = start_off(scene, bone, rng, REACH["near"])
    return {"fault": fault, **registered(scene, bone, list(scene.images.values()), views, start)}


def noticed_trial(case: tuple[int, int]) -> float:
    """Return the smallest of SIZES, mm or °, by which a bone was noticed to move between the images, inf for none.

    `case`: scene, and which of six movements: along WAYS, then about them. Larger ones are taken to be noticed too.
    """
    k, way = case
    scene, bone, start = movable(k)
    axis = np.random.default_rng([MOVED_SEED, *case]).choice([-1.0, 1.0]) * beam_axes(scene)[way % 3]
    step = np.append(np.zeros(3), axis) if way < len(WAYS) else np.append(np.deg2rad(axis), np.zeros(3))
    found = bisect_left(SIZES, True, key=lambda size: not moved_trial(scene, bone, size * step, start)["trusted"])
    return (*SIZES, np.inf)[found]


def hidden_trial(k: int) -> Record:
    """Return what a bone that moved by one of HIDDEN between the images gave; by turns each."""
    name = list(HIDDEN)[k % len(HIDDEN)]
    scene, bone, start = movable(k)
    along, *beside = beam_axes(scene)
    angle = np.random.default_rng([MOVED_SEED, k]).uniform(0, 2 * np.pi)
    aside = np.array([np.cos(angle), np.sin(angle)]) @ beside
    turn_deg, aside_mm, along_mm = HIDDEN[name]
    step = np.concatenate([np.deg2rad(turn_deg) * aside, aside_mm * aside + along_mm * along])
    return {"movement": name, **moved_trial(scene, bone, step, start)}


@lru_cache(maxsize=1)  # movements of one scene come one after another
def movable(k: int) -> tuple[BoneScene, ScannedBone, BoneStart]:
    """Return a scene without a fault, its bone, and a start."""
    scene = draw_bone_scene(MOVED_SEED + k, chain="panel")
    bone = ScannedBone.of_ct(scene.ct)
    return scene, bone, start_off(scene, bone, np.random.default_rng([MOVED_SEED, k, 1]), REACH["near"])


def seen_moved(view: Any, motion: RigidTransform) -> CalibratedView:
    """Return the view of a matrix, of whose image the bone moved by `motion` since the others."""
    return view_from_matrix(view.matrix @ motion.inv().as_matrix(), view.covariance, view.name)


def beam_axes(scene: BoneScene) -> np.ndarray:
    """Return unit vectors (3, 3), CFCS: the last beam at the bone, the first one's part across it, their normal."""
    first, last = (scene.pose.apply(scene.targets_mm[0]) - v.focal_point_mm for v in scene.true_views.values())
    along, beside = unit(last), unit(across(first, unit(last)))
    return np.array([along, beside, np.cross(along, beside)])


def moved_trial(scene: BoneScene, bone: ScannedBone, step: np.ndarray, start: BoneStart) -> Record:
    """Return what exact views gave of a bone that moved by `step` (6,), as of `moved`, before the last image; errors
    are those of where it then lies."""
    motion = moved(RigidTransform.identity(), step, scene.pose.apply(bone.centre_mm))
    first, last = scene.exact_views()
    views = [first, seen_moved(last, motion)]
    after = replace(scene, pose=motion * scene.pose)
    return registered(after, bone, list(scene.images.values()), views, start)
