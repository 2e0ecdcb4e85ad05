"""What is published for ROS 2, as plain values: lengths in m, quaternions x y z w, frames by name (docs/live.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

BASE = "base_link"  # [src: REP-105's name of a robot's own frame, and UR's and Franka's drivers]
OK, WARN, ERROR = range(3)  # levels of diagnostic_msgs/msg/DiagnosticStatus


@dataclass(frozen=True, eq=False)
class FramePose:
    """Place of `frame` in `parent`: `position_m` (3,), `quaternion` (4,)."""

    parent: str
    frame: str
    position_m: np.ndarray
    quaternion: np.ndarray

    @classmethod
    def of(cls, parent: str, frame: str, pose: RigidTransform) -> Self:
        """Return the place by `pose`, mm, which takes points of `frame` to `parent`."""
        return cls(parent, frame, 1e-3 * pose.translation, pose.rotation.as_quat())


@dataclass(frozen=True, eq=False)
class ImageCamera:
    """A pinhole at the origin of `frame` along +z: `matrix` (3, 3), px, of an image of `shape` (rows, columns).

    `stamped_s`: time of the image, s since 1970; 0 if unknown, which tf takes for the newest.
    """

    frame: str
    stamped_s: float
    matrix: np.ndarray
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Picture:
    """An image as PNG, of the pinhole `camera`. `encoding`: of its pixels, "mono8" or "mono16"."""

    camera: ImageCamera
    encoding: str
    png: bytes


@dataclass(frozen=True, eq=False)
class Text:
    """A text for people."""

    text: str


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """State of one part: `level` is OK, WARN or ERROR. `values`: texts by name."""

    name: str
    level: int
    text: str
    values: Mapping[str, str] = field(default_factory=dict)


Value = FramePose | ImageCamera | Picture | Text | tuple[FramePose, ...] | tuple[Diagnosis, ...]
