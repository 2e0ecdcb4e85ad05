"""A check shot on the twin: two more images with the wire in the bone, and the wire found in them."""

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
from sightline.twin.specimens import tagged

ATTEMPTS = 200
MARGIN_PX = 20.0  # minimum distance of wire and landmarks from the edge of the field


@dataclass(frozen=True, eq=False)
class CheckImages:
    """Both radiographs of a check shot, and the true set-up and bone that they show."""

    setup: SetUp
    hip: HipScene
    images: dict[str, Radiograph]

    @staticmethod
    def take(
        planned: SetUp, hip: HipScene, wire_mm: np.ndarray, motion: RigidTransform, rng: np.random.Generator
    ) -> "CheckImages":
        """Render the check images, with the wire (2, 3), planning CFCS, in the bone, and the bone moved against the
        frame by `motion`. The C-arm is set up again. Raises SetUpError if no set-up shows wire and landmarks."""
        then = replace(hip, bone=hip.bone + guide_wire(wire_mm), motions={"check": motion}).at("check")
        points = np.concatenate([motion.apply(wire_mm), np.stack(list(then.landmarks_mm.values()))])
        chain, same_arm = planned.views[VIEWS[0]].chain.name, Variation(tube=planned.tube)
        for _ in range(ATTEMPTS):
            drawn = draw_setup(rng, planned.frame, side=planned.side, chain=chain, variation=same_arm)
            setup = replace(drawn, true_frame=planned.true_frame)
            if all(view.in_field(view.project(points), MARGIN_PX).all() for view in setup.views.values()):
                images = {name: tagged(setup, name, render(setup, name, then.scene, rng)) for name in VIEWS}
                return CheckImages(setup, then, images)
        raise SetUpError(f"none of {ATTEMPTS} set-ups shows wire and landmarks in both check images")

    def landmarks_px(self, names: Sequence[str], sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a person's picks (2, L, 2) of the named landmarks in both images."""
        xyz = np.stack([self.hip.landmarks_mm[name] for name in names])
        true = np.stack([self.setup.views[name].project(xyz) for name in VIEWS])
        return true + sd_px * rng.standard_normal(true.shape)

    def compare(self, plan: Plan, views: Sequence[BeadView], landmarks: Landmarks) -> CheckShot:
        """Find the wire in both images and compare it with a plan made on `views`. Raises SightlineError."""
        images = [self.images[name] for name in VIEWS]
        return check_shot(plan, views, images, self.setup.frame, landmarks=landmarks)
