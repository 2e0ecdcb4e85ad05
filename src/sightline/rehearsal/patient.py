"""A rehearsed patient of any procedure: set-up and bone drawn from one seed, its images, and the truth of every click.

Each part has its own generator, so it does not depend on the parts drawn before it: it is the same after a restart and
in the robot's separate process.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.views import NAMES as VIEWS
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning.procedures import kind
from sightline.rehearsal.check_images import CheckImages
from sightline.robot.kinematics.calibrated import REMOUNT_SD
from sightline.twin import BoneScene, HipScene, Scene, SetUp, Variation, draw_setup, render, truth_document
from sightline.twin.bone_scene import BONES, bone_document, shown_bone_scene
from sightline.twin.bones import Aid, SphereAid
from sightline.twin.drawn_aids import drawn_aids, hip_aids
from sightline.twin.specimens import tagged

PARTS = (*VIEWS, "robot", "check", "picks", "ALIGNED", "PAUSED")  # each has its own generator; add new parts at the end
LANDMARK_MARGIN_PX = 30.0  # landmarks nearer to the edge of a field are not picked [ours]
RIM_ANGLES_RAD = np.array([0.3, 2.4, 4.5])  # about a third of the outline apart
CAP_ANGLES_RAD = np.deg2rad([-65.0, 0.0, 65.0])  # on a cap that a plane cuts off, from its top: the rim is round [ours]
AidClicks: TypeAlias = Mapping[str, Sequence[np.ndarray | None]]
BONE_OF = {"slipped-epiphysis-pin": "growing-femur", "iliosacral-screw": "pelvis", "pedicle-screw": "vertebra"}


@dataclass(frozen=True, eq=False)
class RehearsedPatient:
    """A patient in or beside a frame in front of a C-arm, for a `procedure` by its key: the true `setup` and `bone`."""

    seed: int
    setup: SetUp
    bone: HipScene | BoneScene
    procedure: str = "hip-screw"

    @staticmethod
    def of_bone(
        procedure: str, seed: int, frame: Frame, side: str = "right", *, imaged: bool = True
    ) -> "RehearsedPatient":
        """Draw a patient for one of BONE_OF; both views show the whole wire. `imaged`: the bone absorbs; without it
        there are no images, but all points.

        Raises SetUpError, also for plates whose beams are not those of the procedure.
        """
        setup, bone = shown_bone_scene(np.random.default_rng(seed), frame, BONE_OF[procedure], side, imaged=imaged)
        return RehearsedPatient(seed, _renamed(setup), bone, procedure)

    def generator(self, part: str) -> np.random.Generator:
        """Return the generator of one of PARTS in its initial state."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(PARTS.index(part),)))

    @property
    def side(self) -> str:
        """The patient's side."""
        return self.setup.side

    @property
    def wires_mm(self) -> np.ndarray:
        """Entry and end (n, 2, 3) of the ideal wires, CFCS."""
        return self.bone.wires_mm

    @property
    def scene(self) -> Scene:
        """Everything in the beam at the planning images."""
        return self.bone.scene

    @cached_property
    def images(self) -> dict[str, Radiograph]:
        """The radiograph of each view."""
        scene = self.scene
        made = {name: render(self.setup, name, scene, self.generator(name)) for name in VIEWS}
        return {name: tagged(self.setup, name, image) for name, image in made.items()}

    def pixels(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the true pixels (2, N, 2) of points (N, 3), CFCS, in both images."""
        return np.stack([self.setup.views[name].project(xyz_mm) for name in VIEWS])

    @cached_property
    def landmarks(self) -> dict[str, np.ndarray]:
        """Pixels (2, 2) in both images of each landmark that is picked, by its name in the twin: those that the
        procedure names, or of a procedure for any bone the first ones, as far as they lie well inside both fields."""
        known = self.bone.landmarks_mm
        asked = [one.key for one in kind(self.procedure).landmarks]
        named = [name for name in known if _key(name) in asked]
        uv = self.pixels(np.stack(list(known.values())))
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        seen = {name: uv[:, k] for k, name in enumerate(known) if shown[0][k] and shown[1][k]}
        picked = [name for name in seen if name in named] if named else list(seen)[: len(asked)]
        return {name: seen[name] for name in picked}

    @property
    def landmark_keys(self) -> tuple[str, ...]:
        """The keys of `landmarks` in the procedure's file."""
        asked = [one.key for one in kind(self.procedure).landmarks]
        keys = tuple(_key(name) for name in self.landmarks)
        return keys if set(keys) <= set(asked) else tuple(asked[: len(keys)])

    @cached_property
    def aids_px(self) -> AidClicks:
        """True clicks (M, 2) in each image on the aids that are drawn, by their keys in the procedure's file: all whose
        clicks lie in the fields. None in an image in which the aid is not drawn."""
        procedure = kind(self.procedure)
        asked = {aid.key: [view.name in aid.views for view in procedure.document.views] for aid in procedure.aids}
        known = {name: aid for name, aid in self._aids.items() if _key(name) in asked}
        out = {key: [uv[view] for view in VIEWS] for key, uv in drawn_aids(known, self.setup.views).items()}
        for name, aid in known.items():
            if isinstance(aid, SphereAid) and "growth plate" in known:  # which cuts the sphere off
                out[name] = list(self.rim_px(aid.centre_mm, aid.radius_mm, np.diff(self.wires_mm[0], axis=0)[0]))
        return {
            key: [uv if drawn else None for uv, drawn in zip(each, asked[key], strict=False)]
            for key, each in out.items()
            if all(self.setup.views[view].in_field(uv).all() for view, uv in zip(VIEWS, each, strict=True))
        }

    @property
    def _aids(self) -> Mapping[str, Aid]:
        bone = self.bone
        return bone.aids if isinstance(bone, BoneScene) else hip_aids(bone.femur, self.side, bone.head_mm)

    def rim_px(self, centre_mm: np.ndarray, radius_mm: float, top: np.ndarray | None = None) -> np.ndarray:
        """Return the pixels (2, 3, 2) in both images of three points around the outline of a sphere: at RIM_ANGLES_RAD,
        or on its cap in the direction `top` (3,) at CAP_ANGLES_RAD."""
        out = np.zeros((2, len(RIM_ANGLES_RAD), 2))
        for k, name in enumerate(VIEWS):
            view = self.setup.views[name]
            ray = centre_mm - view.focal_point_mm
            distance = np.linalg.norm(ray)
            across, angles = np.linalg.svd(ray[None] / distance)[2][1:], RIM_ANGLES_RAD
            if top is not None:
                angles = CAP_ANGLES_RAD + np.arctan2(*(across @ top)[::-1])
            # Tangent rays touch the sphere on a circle that is nearer to the source and smaller than the sphere.
            nearer = centre_mm - ray * (radius_mm / distance) ** 2
            touching = radius_mm * np.sqrt(1.0 - (radius_mm / distance) ** 2)
            around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            out[k] = view.project(nearer + touching * around @ across)
        return out

    def shown_again(self, wire_mm: np.ndarray) -> CheckImages:
        """Render two more images with a wire (2, 3), CFCS of the planning images, in the bone.

        The C-arm is set up again and the frame put back as repeatably as a block on its mount. Raises SetUpError.
        """
        rng = self.generator("check")
        motion = RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        return self._check_images(wire_mm, motion, rng)

    @property
    def truth(self) -> dict[str, Any]:
        """The truth of the images as JSON types."""
        if isinstance(self.bone, HipScene):
            return truth_document(self.setup, self.bone)
        return bone_document(self.setup, self.bone)

    def _check_images(
        self, wire_mm: np.ndarray, motion: RigidTransform, rng: np.random.Generator, shown_mm: np.ndarray | None = None
    ) -> CheckImages:
        """Render two more images with a wire in the bone, and with the bone moved against the frame."""
        landmarks = self.bone.landmarks_mm
        if isinstance(self.bone, BoneScene):  # whose images do not show all of them
            landmarks = {name: landmarks[name] for name in self.landmarks}
        return CheckImages.take(
            self.setup,
            self.bone,
            (wire_mm, kind(self.procedure).wire_mm),
            motion,
            (rng, self._set_up_again),
            landmarks_mm=landmarks,
            shown_mm=wire_mm if shown_mm is None else shown_mm,
        )

    def _set_up_again(self, rng: np.random.Generator) -> SetUp:
        """Draw another set-up of the same C-arm."""
        frame, chain, side = self.setup.frame, self.setup.views[VIEWS[0]].chain.name, self.side
        if self.procedure in BONE_OF:
            again = BONES[BONE_OF[self.procedure]].setup(rng, frame, side, self.setup.tube, check=True, chain=chain)
            return _renamed(again)
        return draw_setup(rng, frame, side=side, chain=chain, variation=Variation(tube=self.setup.tube))


def _renamed(setup: SetUp) -> SetUp:
    """Return the set-up with its views named as those of every pair of images are, in their order."""
    views = {name: replace(view, name=name) for name, view in zip(VIEWS, setup.views.values(), strict=True)}
    return replace(setup, views=views)


def _key(name: str) -> str:
    return "-".join(name.split())
