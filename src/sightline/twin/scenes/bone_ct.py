"""The CT of a scene's bone, in coordinates of its own: truth for registrations."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import UnusableInputError
from sightline.imaging.volumes.ct import CFCS_OF_PATIENT, HU, CtScan, hu_of_bone
from sightline.twin.objects.things import Scene

FAT_HU = -110  # around the bone [ours]: the reader of CT scans wants fat or air, and beams of both look alike here
# [ours] of the patient in the scanner against the operating table: rotation about each axis, and shift
_TURN_RAD, _SHIFT_MM = np.deg2rad(15.0), 150.0


def bone_ct(scene: Scene, side: str, rng: np.random.Generator) -> tuple[CtScan, RigidTransform]:
    """Return the CT of a scene's bone, and the pose that takes its coordinates, mm, to CFCS.

    The CT is in patient coordinates, rotated and shifted at random. Raises UnusableInputError unless the scene has one
    volume of bone.
    """
    bones = [volume for volume in scene.volumes if volume.material == "bone"]
    if len(bones) != 1 or bones[0].within is None:
        raise UnusableInputError("the scene has no bone as one volume in soft tissue; simulate a hip for a CT of it")
    (bone,) = bones
    turn = Rotation.from_matrix(CFCS_OF_PATIENT[side]) * Rotation.from_rotvec(rng.uniform(-_TURN_RAD, _TURN_RAD, 3))
    pose = RigidTransform.from_components(rng.uniform(-_SHIFT_MM, _SHIFT_MM, 3), turn)
    hu = np.where(bone.values > 0, np.clip(hu_of_bone(bone.values), *HU), FAT_HU)
    origin, axes = pose.inv().apply(bone.origin_mm), pose.inv().rotation.apply(bone.axes)
    return CtScan(np.rint(hu).astype(np.int16), origin, bone.voxel_mm, axes), pose
