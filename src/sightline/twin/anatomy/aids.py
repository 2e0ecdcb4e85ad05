"""What a person would draw of a bone's aids on images: their true pixels, by the keys of procedures' files."""

from collections.abc import Mapping

import numpy as np

from sightline.twin.anatomy.bone_model import Aid, LineAid, PlaneAid, SphereAid, TubeAid
from sightline.twin.anatomy.femur import NARROWEST, Femur, to_cfcs
from sightline.twin.xray.setup import ViewTruth

END_ON = np.cos(np.pi / 4)  # an oval tube nearer to the beam than this shows its section, others their borders [ours]
_TOUCHES = 4  # iterations of a border's tangent point; each reduces its error a hundredfold
RIM_ANGLES_RAD = np.radians([100.0, 190.0, 340.0])  # of the clicks on a sphere's rim


def drawn_aids(aids: Mapping[str, Aid], views: Mapping[str, ViewTruth]) -> dict[str, dict[str, np.ndarray]]:
    """Return the true pixels of clicks, (M, 2) by aid and view, of aids in CFCS (`BoneScene.aids`, `hip_aids`).

    The names of the aids are those of procedures' files, with "-" for a space: "growth plate" is "growth-plate".

    - a sphere: three clicks on its rim
    - a line: its ends
    - a plane: the ends of its diameter perpendicular to the beam
    - a tube: two clicks on one border and two on the other; of an oval one seen end-on the ends of the long axis of its
      section, then those of the short one
    """
    return {
        key_of(name): {view.name: view.project(clicked_mm(aid, view.focal_point_mm)) for view in views.values()}
        for name, aid in aids.items()
    }


def key_of(name: str) -> str:
    """Return the key in procedures' files of an aid or a landmark of the twin, by its name."""
    return name.replace(" ", "-")


def hip_aids(femur: Femur, side: str, head_mm: np.ndarray) -> dict[str, Aid]:
    """Return head, neck, shaft and outline of the neck of a hip, CFCS, with its head's centre at (3,)."""
    along = femur.towards_head
    first, second = np.linalg.svd(along[None])[2][1:]
    outline = femur.base_mm + np.outer([0.45, 0.65], femur.neck_length_mm * along)
    aids: dict[str, Aid] = {
        "head": SphereAid(np.zeros(3), femur.head_radius_mm),
        "neck": LineAid(np.stack([femur.base_mm, np.zeros(3)])),
        "shaft": LineAid(femur.base_mm + np.array([[0.0, 15.0, 0.0], [0.0, 50.0, 0.0]])),
        "outline": TubeAid(outline, 1e-6 * np.stack([first, second]), NARROWEST * femur.neck_radius_mm),
    }
    return {name: aid.mapped(lambda at: to_cfcs(at, side, head_mm)) for name, aid in aids.items()}


def clicked_mm(aid: Aid, focal_mm: np.ndarray) -> np.ndarray:
    """Return the points (M, 3), CFCS, that are clicked in an image with its focal point at (3,)."""
    if isinstance(aid, SphereAid):
        ray = aid.centre_mm - focal_mm
        sine = aid.radius_mm / np.linalg.norm(ray)  # tangent rays touch the sphere on a smaller circle, nearer to them
        around = np.stack([np.cos(RIM_ANGLES_RAD), np.sin(RIM_ANGLES_RAD)], axis=1) @ np.linalg.svd(ray[None])[2][1:]
        return aid.centre_mm - sine**2 * ray + aid.radius_mm * np.sqrt(1 - sine**2) * around
    if isinstance(aid, LineAid):
        return aid.ends_mm
    if isinstance(aid, PlaneAid):
        across = _unit(np.cross(aid.normal, aid.point_mm - focal_mm))
        return aid.point_mm + np.outer([-aid.half_mm, aid.half_mm], across)
    along, middle = _unit(aid.ends_mm[1] - aid.ends_mm[0]), aid.ends_mm.mean(axis=0)
    if aid.oval and abs(along @ _unit(middle - focal_mm)) > END_ON:
        half = np.linalg.norm(aid.across_mm, axis=1, keepdims=True)
        axes = aid.across_mm * (1 + aid.round_mm / half)
        return middle + np.concatenate([axes[:1], -axes[:1], axes[1:], -axes[1:]])
    return np.array([_touched(aid, end, focal_mm, way) for way in (1.0, -1.0) for end in aid.ends_mm])


def _touched(tube: TubeAid, at_mm: np.ndarray, focal_mm: np.ndarray, way: float) -> np.ndarray:
    """Return the point (3,) of a tube's section at a point of its axis that a line of sight touches."""
    along, on = tube.ends_mm[1] - tube.ends_mm[0], at_mm
    for _ in range(_TOUCHES):
        outward = way * _unit(np.cross(along, on - focal_mm))
        on = at_mm + np.sign(tube.across_mm @ outward) @ tube.across_mm + tube.round_mm * outward
    return on


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
