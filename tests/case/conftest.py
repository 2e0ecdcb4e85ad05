"""A plan on a set-up of the twin, from bead centres (no rendering), and the report of it."""

import numpy as np
import pytest

from sightline.case.report.content import PLANNING, Compared, Report, Truth, exposures_of_images
from sightline.case.views import NAMES, ObservedView, calibrate_pair
from sightline.detection import Detections, Observations, RejectedCandidate
from sightline.imaging import Radiograph
from sightline.planning import kind, plan
from sightline.twin import bead_images

WIRE_MM = np.array([[31.3, 28.9, -9.7], [-30.1, -27.7, 8.3]])
LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])
HOSTILE = "<script>alert('x')</script>.dcm"


def seen(setup, name: str) -> ObservedView:
    rng = np.random.default_rng(len(name))
    ids, uv = bead_images(setup, name, rng, 0.1)
    noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)
    image = Radiograph(rng.integers(500, 3000, (1024, 1024)).astype(np.uint16), 4095.0)
    refused = (RejectedCandidate((500.0, 400.0), 4.0, "too <long>"),)
    beads = Detections(
        uv, np.full(len(ids), 8.0), noise, ("ball",) * len(ids), np.full(len(ids), -0.5), (1024, 1024), refused
    )
    return ObservedView(HOSTILE, Observations(name, ids, uv, noise, image_shape=(1024, 1024)), image, beads)


@pytest.fixture(scope="session")
def pair(setup) -> tuple[ObservedView, ObservedView]:
    return seen(setup, "pa"), seen(setup, "lateral")


@pytest.fixture(scope="session")
def truth(setup) -> Truth:
    return Truth(WIRE_MM, np.stack([setup.views[name].project(WIRE_MM) for name in NAMES]))


@pytest.fixture(scope="session")
def report(frame, setup, pair, truth) -> Report:
    images = calibrate_pair(pair, frame, "smooth")
    localized = calibrate_pair(pair, frame, "localized")
    picks = truth.uv_px + np.random.default_rng(2).normal(0.0, 0.5, (2, 2, 2))
    marks = np.stack([setup.views[name].project(LANDMARKS_MM) for name in NAMES])
    views = [image.view for image in images]
    planned = plan(views, picks[:, 0], picks[:, 1], snapped=True, landmarks_uv_px=marks, procedure=kind("free-wire"))
    return Report(
        title="A plan & its report",
        frame=frame,
        images=images,
        plan=planned,
        exposures=exposures_of_images(images, PLANNING, planned.kind),
        provenance={"picks": "drawn"},
        localized=(localized[0].view, localized[1].view),
        truth=truth,
        compared=[Compared("smooth", "by hand", planned.trajectory, truth)],
    )
