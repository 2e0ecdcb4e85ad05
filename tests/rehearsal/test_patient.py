"""Patients of the procedures: what is picked and drawn is true, and belongs to the procedure's file."""

import numpy as np
import pytest

from sightline.case.views import NAMES
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.rehearsal.patient import BONE_OF, CANNULATED, LANDMARK_MARGIN_PX, RehearsedPatient, draw_patient
from sightline.twin.anatomy.bone_model import SphereAid

BLOCK, SEED = Frame.load("block60"), 5


@pytest.fixture(scope="module", params=BONE_OF)
def patient(request) -> RehearsedPatient:
    return draw_patient(request.param, SEED, BLOCK, "left", imaged=False)


def test_both_views_show_the_wire_and_three_landmarks_of_the_procedure(patient: RehearsedPatient) -> None:
    asked = [one.key for one in patient.document.landmarks]
    assert len(patient.landmark_keys) == len(patient.landmarks) >= 3  # a check shot needs three
    assert set(patient.landmark_keys) <= set(asked)
    for k, view in enumerate(NAMES):
        truth = patient.setup.views[view]
        assert truth.name == view
        assert truth.in_field(patient.pixels(patient.wires_mm[0])[k], LANDMARK_MARGIN_PX).all()
        for name, uv in patient.landmarks.items():
            np.testing.assert_allclose(uv[k], truth.project(patient.bone.landmarks_mm[name]), atol=1e-9)


def test_the_views_are_those_of_the_procedure(patient: RehearsedPatient) -> None:
    """Within the tolerance of the file, which set-ups of a drawn frame and C-arm reach."""
    for wanted, view in zip(patient.document.views, patient.setup.views.values(), strict=False):
        beam = view.detector.normal * np.sign((view.detector.origin_mm - view.focal_point_mm) @ view.detector.normal)
        orbit, tilt = np.deg2rad([wanted.orbit_deg, wanted.tilt_deg])
        # Caudal is -Y of a left patient; a positive tilt has the detector towards the head.
        expected = np.array([np.sin(orbit) * np.cos(tilt), np.sin(tilt), np.cos(orbit) * np.cos(tilt)])
        assert np.rad2deg(np.arccos(beam @ expected)) < wanted.within_deg


def test_clicks_on_a_rim_are_tangent_to_the_sphere_away_from_its_cut(patient: RehearsedPatient) -> None:
    for key, uv in patient.aids_px.items():
        sphere = patient.bone.aids[key.replace("-", " ")]
        if not isinstance(sphere, SphereAid):
            continue
        along = patient.wires_mm[0][1] - patient.wires_mm[0][0]
        for k, view in enumerate(NAMES):
            truth = patient.setup.views[view]
            rays = truth.points_on_detector(uv[k]) - truth.focal_point_mm
            rays /= np.linalg.norm(rays, axis=1)[:, None]
            to_centre = sphere.centre_mm - truth.focal_point_mm
            nearest = (rays @ to_centre)[:, None] * rays - to_centre  # from the centre
            np.testing.assert_allclose(np.linalg.norm(nearest, axis=1), sphere.radius_mm, atol=1e-6)
            assert (nearest @ along > 0).all()


def test_plates_do_not_show_inlet_and_outlet() -> None:
    with pytest.raises(SetUpError, match="inlet, outlet"):
        draw_patient("iliosacral-screw", SEED, Frame.load("gamma"), imaged=False)


def test_check_images_show_three_screws_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the views of the plan two of the wires are 2 mm apart."""
    patient, shown = draw_patient(CANNULATED, SEED, BLOCK, imaged=False), {}
    monkeypatch.setattr("sightline.rehearsal.patient.render_views", lambda setup, *_: shown.update(setup.views) or {})
    patient.shown_again({wire.key: mm for wire, mm in zip(patient.document.wires, patient.wires_mm, strict=True)})
    middle = patient.wires_mm.mean(axis=1)
    for view in shown.values():
        uv, along = view.project(middle), view.project(patient.wires_mm[0])[1] - view.project(patient.wires_mm[0])[0]
        across = uv @ np.array([-along[1], along[0]]) / np.linalg.norm(along)
        apart = np.diff(np.sort(across)) * view.chain.pitch_mm
        assert apart.min() > 3.5, apart
