"""The CT of a twin's bone: where its voxels lie by its true pose, what they attenuate; and scenes without one."""

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.imaging.volumes import read_ct
from sightline.imaging.volumes.ct import shares_of_hu, write_ct
from sightline.twin import hip_scene
from sightline.twin.objects.things import Scene
from sightline.twin.scenes.bone_ct import bone_ct


def test_the_ct_lies_where_its_pose_says_and_attenuates_as_the_bone(setup, tmp_path: Path) -> None:
    scene = hip_scene(setup, np.random.default_rng(3)).scene
    (bone,) = scene.volumes
    made, pose = bone_ct(scene, setup.side, np.random.default_rng(5))
    scan = read_ct(write_ct(made, tmp_path / "bone.nrrd"))
    assert (scan.hu == made.hu).all()
    for index in ([0, 0, 0], [31, 7, 12], np.array(bone.values.shape) - 1):
        own = scan.origin_mm + (scan.voxel_mm * index) @ scan.axes
        assert pose.apply(own) == pytest.approx(bone.origin_mm + (bone.voxel_mm * index) @ bone.axes, abs=1e-6)
    bony = (bone.values > 0.05) & (bone.values <= 1)  # beyond cortical bone the models differ by design
    off = shares_of_hu(scan.hu)[1][bony] - bone.values[bony]
    assert bony.sum() > 1e5
    assert np.abs(off).max() < 0.001  # a CT number is 0.0005
    assert np.rad2deg(pose.rotation.magnitude()) > 1.0


def test_a_scene_without_bone_has_no_ct() -> None:
    with pytest.raises(UnusableInputError, match="no bone as one volume"):
        bone_ct(Scene(), "right", np.random.default_rng(1))
