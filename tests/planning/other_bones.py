"""Vertebra, pelvis and growing femur of the twin, and what a person would draw of them on two stand-in views."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from sightline.planning import Aids, Anatomy, Pick, kind, locate
from sightline.twin.anatomy.bone_model import Aid, BoneModel, drawn_aids
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.scenes.bone_scene import BONES, INLET, OUTLET

from .standin import StandInView, stand_in, turned

PROCEDURES = {"vertebra": "pedicle-screw", "pelvis": "iliosacral-screw", "growing-femur": "slipped-epiphysis-pin"}


@cache
def views(name: str, scale: float = 0.05) -> list[StandInView]:
    """PA and lateral stand-in view; of the pelvis inlet and outlet, for a right side, whose head lies towards -Y."""
    pa = stand_in("pa", 0.4, scale)
    if name != "pelvis":
        return [pa, stand_in("lateral", -0.2, scale)]
    angles = {"inlet": np.rad2deg(INLET), "outlet": -np.rad2deg(OUTLET)}
    return [turned(pa, "x", angle, view) for view, angle in angles.items()]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A bone with its wire in the middle of the views, CFCS, and the true clicks on its aids by key and view."""

    name: str
    bone: BoneModel
    origin_mm: np.ndarray
    wire_mm: np.ndarray
    aids: dict[str, Aid]
    uv_px: dict[str, list[np.ndarray | None]]

    @property
    def marks_mm(self) -> dict[str, np.ndarray]:
        """The landmarks (3,) of a right side, CFCS, by their keys."""
        named = self.bone.landmarks_mm.items()
        return {name.replace(" ", "-"): to_cfcs(at, "right", self.origin_mm) for name, at in named}

    def found(self, wire_mm: np.ndarray, uv_px: dict, sd_px: float, seen: list[StandInView] | None = None) -> Anatomy:
        """What is located from clicks on the aids, and on the true picks of a wire."""
        seen = seen or views(self.name)
        picks = [[Pick.free(view.project(point[None])[0], sd_px) for view in views(self.name)] for point in wire_mm]
        return locate(seen, self.made(uv_px, sd_px), picks)

    def made(self, uv_px: dict, sd_px: float = 0.5) -> Aids:
        """The aids of clicks."""
        return Aids.clicked({aid.key: aid.type for aid in kind(PROCEDURES[self.name]).aids}, uv_px, sd_px)


@cache
def drawn(name: str, seed: int = 3, side: str = "right") -> Drawn:
    """A bone that is drawn from a seed."""
    bone = BONES[name].draw(np.random.default_rng(seed)).bone()
    origin = np.array([1.3, -2.2, 0.7]) - to_cfcs(bone.wires_mm[0].mean(axis=0), side, np.zeros(3))
    aids = {key: aid.mapped(lambda at: to_cfcs(at, side, origin)) for key, aid in bone.aids.items()}
    seen = {view.name: view for view in views(name)}
    asked = {aid.key: aid.views for aid in kind(PROCEDURES[name]).aids if aid.key.replace("-", " ") in aids}
    true = drawn_aids({key: aid for key, aid in aids.items() if key.replace(" ", "-") in asked}, seen)
    uv = {key: [true[key][view] if view in each else None for view in seen] for key, each in asked.items()}
    return Drawn(name, bone, origin, to_cfcs(bone.wires_mm[0], side, origin), aids, uv)
