"""Trials of registration for `bench_bone`: scenes of bones, each registered in several ways, and bones with a fault."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.harness import mahalanobis2
from benchmarks.scenes.bones import FAULTS, FIRST_SEED, BoneScene, draw_bone_scene
from sightline.calibration import CalibratedView, view_from_matrix
from sightline.errors import SightlineError
from sightline.from_images.registration import BoneStart, ScannedBone, register_bone
from sightline.imaging import Radiograph
from sightline.imaging.volumes import CtScan

FAULT_SEED = FIRST_SEED + 5000
REACH = {"near": 10.0, "wide": 20.0}  # of a start: mm and degrees along each axis
MOVED_MM = 4.0  # of the bone between the two images
HEAD_FIELD_MM = 35.0  # radius of the field around the head, which has 23 mm [ours]
Record = dict[str, Any]


def right_trial(k: int) -> dict[str, Record]:
    """Return what each way of registering the bone of scene `k` gave, and the scene's strata."""
    scene, rng = draw_bone_scene(FIRST_SEED + k), np.random.default_rng([FIRST_SEED, k])
    bone, images, views = ScannedBone.of_ct(scene.ct), list(scene.images.values()), scene.views()
    near, wide = (start_off(scene, bone, rng, reach) for reach in REACH.values())
    ways = {
        "own": (bone, images, views, near),
        "wide": (bone, images, views, wide),
        "none": (bone, images, views, None),
    }
    if scene.strata["chain"] != "intensifier":
        exact = scene.exact_views()
        ways["exact"], ways["none exact"] = (bone, images, exact, near), (bone, images, exact, None)
        ways["2 mm"] = ScannedBone.of_ct(halved(scene.ct)), images, exact, near
        if scene.strata["anatomy"] == "femur":
            ways["head"] = bone, head_alone(scene), exact, near
    ways["one view"] = bone, images[:1], views[:1], near
    return {"strata": scene.strata} | {way: registered(scene, *given) for way, given in ways.items()}


def start_off(scene: BoneScene, bone: ScannedBone, rng: np.random.Generator, reach: float) -> BoneStart:
    """Return a start that is off by up to `reach`, mm and degrees, along each axis."""
    centre, shift = scene.pose.apply(bone.centre_mm), rng.uniform(-reach, reach, 3)
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-reach, reach, 3)))
    off = RigidTransform.from_components(centre + shift - turn.apply(centre), turn)
    return BoneStart(off * scene.pose, reach, np.deg2rad(reach))


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
    start: BoneStart | None,
) -> Record:
    """Return errors of a pose: `error_mm` mean of the targets, `turn_deg`, squared lengths over the stated error of the
    pose and of the targets; whether it is trusted, and the failed checks. "said": why there is none."""
    try:
        found = register_bone(bone, images, views, start)
    except SightlineError as refusal:
        return {"said": str(refusal), "error_mm": np.inf, "trusted": False}
    off = scene.pose.apply(scene.targets_mm) - found.at(scene.targets_mm)
    change = scene.pose * found.pose.inv()
    step = np.concatenate([change.rotation.as_rotvec(), change.apply(found.centre_mm) - found.centre_mm])
    by_target = np.array([found.covariance_at(target[None]) for target in scene.targets_mm])
    return {
        "error_mm": float(np.linalg.norm(off, axis=1).mean()),
        "turn_deg": float(np.rad2deg(change.rotation.magnitude())),
        "pose2": float(mahalanobis2(step, found.covariance)),
        "targets2": mahalanobis2(off, by_target),
        "trusted": found.trusted,
        "failed": [check.name for check in found.checks if not check.passed],
    }


def fault_trial(k: int) -> Record:
    """Return what a scan or a bone with a fault gave with exact views; by turns one fault, or a bone that moved."""
    fault = (*FAULTS, "moved")[k % (len(FAULTS) + 1)]
    scene = draw_bone_scene(FAULT_SEED + k, chain="panel", fault=None if fault == "moved" else fault)
    rng, bone, views = np.random.default_rng([FAULT_SEED, k]), ScannedBone.of_ct(scene.ct), scene.exact_views()
    if fault == "moved":
        views[1] = seen_moved(views[1], rng)
    start = start_off(scene, bone, rng, REACH["near"])
    return {"fault": fault, **registered(scene, bone, list(scene.images.values()), views, start)}


def seen_moved(view: Any, rng: np.random.Generator) -> CalibratedView:
    """Return the view of a matrix by which the bone has moved by MOVED_MM."""
    matrix, way = view.matrix.copy(), rng.standard_normal(3)
    matrix[:, 3] -= matrix[:, :3] @ (MOVED_MM * way / np.linalg.norm(way))
    return view_from_matrix(matrix, view.covariance, view.name)
