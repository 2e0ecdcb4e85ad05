"""Rigid motions of things in the beam: placing a phantom, displacing a fragment, a patient who moves."""

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
    """How far a leg moves while one thinks it still: s.d. per axis [ours]."""

    shift_mm: float = 1.0
    turn: float = radians(0.5)


def draw_motion(rng: np.random.Generator, about_mm: np.ndarray, spread: BoneMotion | None = None) -> RigidTransform:
    """A small rigid motion in CFCS, its rotation about a point (3,)."""
    spread = spread or BoneMotion()
    turn = Rotation.from_rotvec(rng.normal(0.0, spread.turn, 3))
    about = np.asarray(about_mm)
    return RigidTransform.from_components(about + rng.normal(0.0, spread.shift_mm, 3) - turn.apply(about), turn)


def moved(thing: Thing, motion: RigidTransform) -> Thing:
    """A thing, or all of a scene but its body, after a rigid motion: p becomes motion.apply(p)."""
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
