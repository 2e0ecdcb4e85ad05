"""What a person clicks and draws of a plan on two images of a drawn patient, as pixels; nothing is rendered."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.view import CalibratedView
from sightline.errors import SetUpError
from sightline.planning import Aids, MatchingCurve, Plan, Procedure, plan
from sightline.planning.bone.directions import across, anatomical, unit
from sightline.planning.procedures.document import WantedView
from sightline.rehearsal.patient import RehearsedPatient
from sightline.studies.scenes import MARGIN_PX, VIEWS

PICK_PX = 0.5  # a careful click (physics.md, Picks)
Pixels = Mapping[str, np.ndarray]


def clicks(patient: RehearsedPatient, wire_mm: np.ndarray) -> dict[str, np.ndarray]:
    """Return the true pixels (2, N, 2) in both images of a "wire" (2, 3), anatomical, of the procedure's "landmarks",
    and of the clicks on each aid by its key, NaN in an image in which it is not drawn.

    Raises SetUpError where a wire or a landmark lies outside.
    """
    marks = dict(zip(patient.landmark_keys, patient.landmarks.values(), strict=True))
    asked = [landmark.key for landmark in patient.document.landmarks]
    if marks.keys() != set(asked):
        raise SetUpError("a landmark lies outside an image")
    aids = {
        key: np.stack(
            [np.full_like(next(uv for uv in both if uv is not None), np.nan) if uv is None else uv for uv in both]
        )
        for key, both in patient.aids_px.items()
    }
    return {
        "wire": wire_pixels(patient, wire_mm),
        "landmarks": np.stack([marks[key] for key in asked], axis=1),
        **aids,
    }


def wire_pixels(patient: RehearsedPatient, wire_mm: np.ndarray) -> np.ndarray:
    """Return the pixels (2, 2, 2) of a wire (2, 3), anatomical. Raises SetUpError where it lies outside an image."""
    uv = patient.pixels(patient.in_cfcs(wire_mm))
    if not all(patient.setup.views[name].in_field(uv[k], MARGIN_PX).all() for k, name in enumerate(VIEWS)):
        raise SetUpError("a wire lies outside an image")
    return uv


def turned_beams(wanted: Sequence[WantedView], which: int, by_deg: float, about: np.ndarray) -> dict[str, np.ndarray]:
    """Return the nominal beams (3,) of two views by name, anatomical, one of them turned by an angle about the part of
    `about` (3,) that is perpendicular to it."""
    beams = {view.name: np.array(anatomical(view.orbit_deg, view.tilt_deg)) for view in wanted[: len(VIEWS)]}
    beam = beams[wanted[which].name]
    beams[wanted[which].name] = Rotation.from_rotvec(np.deg2rad(by_deg) * unit(across(about, beam))).apply(beam)
    return beams


def jittered(pixels: Pixels, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the pixels with a careful click's noise."""
    return {name: uv + PICK_PX * rng.standard_normal(uv.shape) for name, uv in pixels.items()}


def plan_of(
    views: Sequence[CalibratedView], pixels: Pixels, procedure: Procedure, side: str, undrawn: Collection[str] = ()
) -> Plan:
    """Return the plan of clicks and drawings, without the aids `undrawn`. Raises SightlineError."""
    types = {aid.key: aid.type for aid in procedure.aids if aid.key in pixels and aid.key not in undrawn}
    clicked = {key: [None if np.isnan(uv).any() else uv for uv in pixels[key]] for key in types}
    wire = pixels["wire"]
    return plan(
        views,
        wire[:, 0],
        wire[:, 1],
        landmarks_uv_px=pixels["landmarks"],
        landmark_names=[landmark.key for landmark in procedure.landmarks],
        kind=procedure,
        side=side,
        aids=Aids.clicked(types, clicked),
        curve=_no_curve,
    )


def _no_curve(*_: object) -> MatchingCurve:
    """Return a curve that nothing looks at: drawing one takes most of the time of a plan."""
    nothing, pixels = np.zeros(0), np.zeros((0, 2))
    return MatchingCurve("pa", "lateral", nothing, np.zeros((0, 3)), pixels, pixels, nothing.astype(bool), lambda: None)
