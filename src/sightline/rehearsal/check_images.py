"""A check shot on the twin: two more images with the wire in the bone, and what is found in them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration import BeadView
from sightline.case.views import NAMES as VIEWS
from sightline.errors import SetUpError
from sightline.imaging import Radiograph
from sightline.pipeline import check_shot
from sightline.planning import Plan
from sightline.planning.check_shot import CheckShot, Landmarks
from sightline.twin import HipScene, SetUp, Variation, draw_setup, render
from sightline.twin.implants import guide_wire

ATTEMPTS = 200
MARGIN_PX = 20.0  # of wire and landmarks from the field's edge


@dataclass(frozen=True, eq=False)
class CheckImages:
    """Both radiographs of a check, and the set-up and bone they were made of."""

    setup: SetUp
    hip: HipScene
    images: dict[str, Radiograph]

    @staticmethod
    def take(
        planned: SetUp, hip: HipScene, wire_mm: np.ndarray, motion: RigidTransform, rng: np.random.Generator
    ) -> "CheckImages":
        """With the wire (2, 3), planning CFCS, in the bone, and the bone moved against the frame. The C-arm is brought
        anew. Raises SetUpError where no set-up shows it all."""
        then = replace(hip, bone=hip.bone + guide_wire(wire_mm), motions={"check": motion}).at("check")
        points = np.concatenate([motion.apply(wire_mm), np.stack(list(then.landmarks_mm.values()))])
        chain, same_arm = planned.views[VIEWS[0]].chain.name, Variation(tube=planned.tube)
        for _ in range(ATTEMPTS):
            drawn = draw_setup(rng, planned.frame, side=planned.side, chain=chain, variation=same_arm)
            setup = replace(drawn, true_frame=planned.true_frame)
            if all(view.in_field(view.project(points), MARGIN_PX).all() for view in setup.views.values()):
                return CheckImages(setup, then, {name: render(setup, name, then.scene, rng) for name in VIEWS})
        raise SetUpError(f"no set-up of {ATTEMPTS} shows wire and landmarks in both check images")

    def landmarks_px(self, names: Sequence[str], sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """(2, L, 2): landmarks of the hip by their names, as a person finds them again."""
        xyz = np.stack([self.hip.landmarks_mm[name] for name in names])
        true = np.stack([self.setup.views[name].project(xyz) for name in VIEWS])
        return true + sd_px * rng.standard_normal(true.shape)

    def compare(self, plan: Plan, views: Sequence[BeadView], landmarks: Landmarks) -> CheckShot:
        """The wire found in both against a plan made on `views`. Raises SightlineError."""
        images = [self.images[name] for name in VIEWS]
        return check_shot(plan, views, images, self.setup.frame, landmarks=landmarks)
