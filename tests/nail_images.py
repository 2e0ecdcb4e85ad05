"""Small images of a nail on a flat panel, with views known from their geometry."""

from dataclasses import dataclass, replace

import numpy as np
from benchmarks.scenes.nails import Sight, ends_of_outlines

from sightline.calibration import CalibratedView, view_from_matrix
from sightline.common.geometry.planes import Plane
from sightline.imaging import Radiograph
from sightline.twin.anatomy.nailed_femur import CORTEX_MM, THIGH_MM, DistalNail
from sightline.twin.objects.things import Rod, Scene, SoftTissue
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.presets import FLAT_PANEL
from sightline.twin.xray.render import DOSES, expose
from sightline.twin.xray.setup import ViewTruth
from sightline.twin.xray.tubes import FlatPanel

PANEL = replace(FLAT_PANEL, shape=(340, 340), field_mm=340 * 0.194, mask_px=168.0)
ORBITS_DEG = (-16.0, 17.0)
POSE_SD = np.repeat([1e-4, 0.03], 3)  # rad and mm: a stated error of each view


@dataclass(frozen=True, eq=False)
class NailImages:
    """Two images of a nail, their views, and what a person would draw without any error."""

    nail: DistalNail
    views: list[CalibratedView]
    images: list[Radiograph]
    strokes_px: np.ndarray
    clicks_px: np.ndarray


def nail_images(nail: DistalNail, seed: int, more: Scene | None = None) -> NailImages:
    """Render a nail in a femur's shaft from 16 to 17° to either side; `more`: other things in the beam."""
    rng = np.random.default_rng(seed)
    truths = [_truth(f"view{k}", angle) for k, angle in enumerate(ORBITS_DEG)]
    (x, y, z), (a, b, c), (outer, inner) = nail.hole_mm.tolist(), nail.along.tolist(), CORTEX_MM
    shaft = Rod((x, y, z), (a, b, c), outer, 150.0, inner, within="tissue", material="bone")
    scene = Scene(solids=(shaft,), meshes=(nail.mesh(),), tissue=SoftTissue((x, z), THIGH_MM))
    scene = scene if more is None else scene + more
    sights = [Sight(truth.focal_point_mm, truth.project) for truth in truths]
    return NailImages(
        nail,
        [_known(truth) for truth in truths],
        [expose(truth, scene, DOSES["medium"]).read_out(rng) for truth in truths],
        np.array([ends_of_outlines(nail, sight, 16.0) for sight in sights]),
        np.array([truth.project(nail.hole_mm[None])[0] for truth in truths]),
    )


def _truth(name: str, orbit_deg: float) -> ViewTruth:
    beam = beam_at(np.deg2rad(orbit_deg))
    axes = np.stack([np.cross([0.0, 1.0, 0.0], beam), [0.0, 1.0, 0.0]])
    return ViewTruth(name, -620.0 * beam, Plane(400.0 * beam, axes), FlatPanel(PANEL).undistorted)


def _known(truth: ViewTruth) -> CalibratedView:
    """The view of a matrix, with the covariance of small errors of its pose."""
    beam, axes = truth.detector.normal, truth.detector.axes
    depth = float((truth.detector.origin_mm - truth.focal_point_mm) @ beam)
    inner = np.array(
        [[depth / PANEL.pitch_mm, 0.0, PANEL.centre_px[0]], [0.0, depth / PANEL.pitch_mm, 0.0], [0, 0, 1.0]]
    )
    inner[1, 2] = PANEL.centre_px[1]
    rotation = np.vstack([axes, beam])
    matrix = inner @ np.column_stack([rotation, -rotation @ truth.focal_point_mm])
    moves = []
    for k in range(6):
        twist = np.zeros((4, 4))
        if k < 3:
            twist[:3, :3] = np.cross(np.eye(3)[k], np.eye(3)).T
        else:
            twist[k - 3, 3] = 1.0
        moves.append((matrix @ twist).ravel() * POSE_SD[k])
    return view_from_matrix(matrix, np.array(moves).T @ np.array(moves), truth.name)
