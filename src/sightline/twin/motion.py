"""Rigid motions of objects in the beam: placing a phantom, displacing a fragment, movement of the patient."""

from dataclasses import dataclass, replace
from math import radians
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.twin.meshes import Mesh
from sightline.twin.things import Ball, Box, Point, Rod, Scene
from sightline.twin.volumes import Volume

Thing = TypeVar("Thing", bound=Ball | Rod | Box | Volume | Mesh | Scene)


@dataclass(frozen=True)
class BoneMotion:
    """Unnoticed motion of a leg: s.d. per axis [ours]."""

    shift_mm: float = 1.0
    rotation: float = radians(0.5)


def draw_motion(rng: np.random.Generator, about_mm: np.ndarray, spread: BoneMotion | None = None) -> RigidTransform:
    """Draw a small rigid motion in CFCS, with its rotation about a point (3,)."""
    spread = spread or BoneMotion()
    rotation = Rotation.from_rotvec(rng.normal(0.0, spread.rotation, 3))
    about = np.asarray(about_mm)
    shift = about + rng.normal(0.0, spread.shift_mm, 3) - rotation.apply(about)
    return RigidTransform.from_components(shift, rotation)


def moved(thing: Thing, motion: RigidTransform) -> Thing:
    """Return an object, or a scene without moving its body, after a rigid motion: p becomes motion.apply(p)."""
    rotation = motion.rotation.as_matrix()
    match thing:
        case Ball():
            return replace(thing, centre_mm=_point(motion, thing.centre_mm))
        case Rod():
            x, y, z = (float(c) for c in rotation @ thing.axis)
            return replace(thing, centre_mm=_point(motion, thing.centre_mm), axis=(x, y, z))
        case Box():
            return replace(thing, centre_mm=motion.apply(thing.centre_mm), axes=thing.axes @ rotation.T)
        case Volume():
            return replace(thing, origin_mm=motion.apply(thing.origin_mm), axes=thing.axes @ rotation.T)
        case Mesh():
            return replace(thing, vertices_mm=motion.apply(thing.vertices_mm))
        case Scene():
            return replace(
                thing,
                solids=tuple(moved(one, motion) for one in thing.solids),
                boxes=tuple(moved(one, motion) for one in thing.boxes),
                volumes=tuple(moved(one, motion) for one in thing.volumes),
                meshes=tuple(moved(one, motion) for one in thing.meshes),
            )


def _point(motion: RigidTransform, at: Point) -> Point:
    x, y, z = (float(c) for c in motion.apply(np.array(at)))
    return x, y, z
