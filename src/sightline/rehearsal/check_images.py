"""A check shot on the twin: two more images with the wire in the bone, and the wire found in them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration import BeadView
from sightline.case.views import NAMES as VIEWS
from sightline.errors import SetUpError
from sightline.from_images.pipeline import check_shot
from sightline.imaging import Radiograph
from sightline.planning import Plan
from sightline.planning.check.shot import CheckShot, Landmarks
from sightline.twin import BoneScene, HipScene, SetUp
from sightline.twin.objects.implants import guide_wire
from sightline.twin.objects.things import moved
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.render import render_views

ATTEMPTS = 200
MARGIN_PX = 20.0  # minimum distance of wire and landmarks from the edge of the field


@dataclass(frozen=True, eq=False)
class CheckImages:
    """Both radiographs of a check shot, and the true set-up and landmarks (3,) that they show.

    `picked_mm` (M, 3): where a person picks the wire in both, the tip last, CFCS of these images.
    """

    setup: SetUp
    landmarks_mm: dict[str, np.ndarray]
    images: dict[str, Radiograph]
    picked_mm: np.ndarray | None = None

    @staticmethod
    def take(
        planned: SetUp,
        bone: HipScene | BoneScene,
        wires: Sequence[tuple[np.ndarray, float]],
        motion: RigidTransform,
        drawn: tuple[np.random.Generator, Callable[[np.random.Generator], SetUp]],
        *,
        landmarks_mm: Mapping[str, np.ndarray],
        shown_mm: np.ndarray,
    ) -> "CheckImages":
        """Render the check images of a bone that has moved against the frame by `motion`.

        `wires`: all in the bone, each its axis to the tip (2, 3), planning CFCS, and its diameter. `drawn`: the
        generator, and the function that draws another set-up of the C-arm. `landmarks_mm`: points of the bone,
        `shown_mm` (N, 3) of the newest wire, before both moved. Raises SetUpError if no set-up shows these.
        """
        rng, draw = drawn
        in_bone = sum((guide_wire(*one) for one in wires), bone.bone)
        then = bone.still + moved(in_bone, motion)
        landmarks = {name: motion.apply(at) for name, at in landmarks_mm.items()}
        points = np.concatenate([motion.apply(shown_mm), np.stack(list(landmarks.values()))])
        for _ in range(ATTEMPTS):
            setup = replace(draw(rng), true_frame=planned.true_frame)
            if all(view.in_field(view.project(points), MARGIN_PX).all() for view in setup.views.values()):
                made = render_views(setup, VIEWS, then, rng)
                images = {name: tagged(setup, name, image) for name, image in made.items()}
                return CheckImages(setup, landmarks, images)
        raise SetUpError(f"none of {ATTEMPTS} set-ups shows wire and landmarks in both check images")

    def landmarks_px(self, names: Sequence[str], sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a person's picks (2, L, 2) of the named landmarks in both images."""
        return self.pixels(np.stack([self.landmarks_mm[name] for name in names]), sd_px, rng)

    def pixels(self, xyz: np.ndarray, sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a person's picks (2, N, 2) of points (N, 3), CFCS of these images, in both images."""
        true = np.stack([self.setup.views[name].project(xyz) for name in VIEWS])
        return true + sd_px * rng.standard_normal(true.shape)

    def compare(self, plan: Plan, views: Sequence[BeadView], landmarks: Landmarks) -> CheckShot:
        """Find the wire in both images and compare it with a plan made on `views`. Raises SightlineError."""
        images = [self.images[name] for name in VIEWS]
        return check_shot(plan, views, images, self.setup.frame, landmarks=landmarks)
