"""The twin's image of the same kind as a given one: a similar plate, balls at the same positions, a patient."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.detection import Detections
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.studies.comparison.lattice import Lattice
from sightline.studies.comparison.measures import NotMeasurableError, field_circle, lattice_of, open_beam, usual_balls
from sightline.twin import Scene, ViewTruth, draw_setup, hip_scene, render
from sightline.twin.objects.things import Ball, Box, Rod, SoftTissue, Solid
from sightline.twin.xray.setup import SetUp, shadow_radius_px

VIEW = "pa"
PLATE_THICKNESS_MM = 1.0  # thickness of the twin's perforated plate [ours]
PLATE_HEIGHT_MM = 5.0  # distance of its centre from the input plane [ours]
BALL_DEPTH = 0.62  # of the distance from the source to the input plane: that of the hip [ours]


@dataclass(frozen=True, eq=False)
class Twin:
    """An image of the twin, its description (`words`), and its set-up."""

    words: str
    image: Radiograph
    setup: SetUp


def twin_of(image: Radiograph, beads: Detections | None, rng: np.random.Generator) -> Twin:
    """Render objects of the kind that the image seems to show, with the twin's default C-arm and dose."""
    setup = draw_setup(rng, Frame.load("gamma"))
    view = setup.views[VIEW]
    lattice = _lattice(beads)
    words = []
    scene = Scene()
    if beads is not None and lattice is not None:
        scene += _grid(view, beads, lattice, _scale(image, view))
        words.append("perforated steel plate" if beads.kind.count("hole") else "grid of steel balls")
    elif beads is not None and _has_balls(beads):
        scene += Scene(solids=_balls(view, image, beads))
        words.append("steel balls in the same places")
    if lattice is None and not open_beam(image, beads):
        scene += Scene(tissue=SoftTissue()) + hip_scene(setup, rng).bone
        words.append("a hip")
    return Twin(" before ".join(words) or "open beam", render(setup, VIEW, scene, rng), setup)


def lattice_mm(view: ViewTruth, lattice: Lattice, pitch_px: float) -> np.ndarray:
    """Return the points (N, 2), detector coordinates, of a lattice of that kind and pitch over a little more than the
    field."""
    pitch = pitch_px / view.intensifier.px_per_mm
    reach = view.chain.field_mm / 2 + 2 * pitch
    count = int(2 * reach / pitch)
    index = np.stack(np.meshgrid(*2 * (np.arange(-count, count + 1),)), axis=-1).reshape(-1, 2)
    xy = pitch * index @ lattice.axes
    return xy[np.linalg.norm(xy, axis=1) < reach]


def _lattice(beads: Detections | None) -> Lattice | None:
    try:
        return lattice_of(beads)
    except NotMeasurableError:
        return None


def _has_balls(beads: Detections) -> bool:
    try:
        return len(usual_balls(beads)) > 0
    except NotMeasurableError:
        return False


def _scale(image: Radiograph, view: ViewTruth) -> float:
    """Return the scale from the image's pixels to the twin's, at equal field size."""
    return view.chain.mask_px / field_circle(image)[1]


def _grid(view: ViewTruth, beads: Detections, lattice: Lattice, scale: float) -> Scene:
    xy = lattice_mm(view, lattice, scale * lattice.pitch_px)
    centre = view.detector.to_space(xy) - PLATE_HEIGHT_MM * view.detector.normal
    radius = scale * float(np.median(beads.radius_px)) / view.intensifier.px_per_mm
    if "hole" not in beads.kind:
        return Scene(solids=tuple(Ball((x, y, z), radius, within=None) for x, y, z in centre.tolist()))
    a, b, c = view.detector.normal.tolist()
    # The twin cannot model air inside a plate, so holes are filled with polyethylene, which absorbs 2 % in 1 mm.
    filled: dict[str, Any] = {"hole_mm": 0.0, "within": "steel", "material": "polyethylene"}
    rods = tuple(Rod((x, y, z), (a, b, c), radius, PLATE_THICKNESS_MM / 2, **filled) for x, y, z in centre.tolist())
    half = np.array([view.chain.field_mm, view.chain.field_mm, PLATE_THICKNESS_MM / 2])
    middle = view.detector.to_space(np.zeros(2)) - PLATE_HEIGHT_MM * view.detector.normal
    return Scene(solids=rods, boxes=(Box(middle, view.detector.basis, half, material="steel"),))


def _balls(view: ViewTruth, image: Radiograph, beads: Detections) -> tuple[Solid, ...]:
    """Return balls whose shadows have the positions and sizes of those in the image."""
    scale, dark = _scale(image, view), beads.contrast < 0
    uv = view.intensifier.centre_px + scale * (beads.uv_px[dark] - field_circle(image)[0])
    seen = view.in_field(uv)
    on_detector = view.points_on_detector(uv[seen])
    places = view.focal_point_mm + BALL_DEPTH * (on_detector - view.focal_point_mm)
    per_mm = shadow_radius_px(view, places, np.ones(len(places)))
    radius = scale * beads.radius_px[dark][seen] / per_mm
    return tuple(Ball((x, y, z), r, within=None) for (x, y, z), r in zip(places.tolist(), radius.tolist(), strict=True))
