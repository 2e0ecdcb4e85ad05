"""Views and their documents: a view is calibrated again from its beads and its frame."""

import json
from dataclasses import replace
from typing import Any

import numpy as np

from sightline.calibration import BeadView, CalibrationInputs, CArm, MatrixView, calibrate
from sightline.calibration.exchange import opencv
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.canonical import plain
from sightline.case.saved.beads import observations
from sightline.case.views import CalibratedImage, ObservedView, view_document
from sightline.common.checks import Check
from sightline.errors import UnusableInputError
from sightline.frame import Frame

# Machines and versions of libraries differ by less; an estimator that has changed, by more [ours].
_SAME_MM = 1e-3


def as_image(view: BeadView) -> CalibratedImage:
    """Return a view as the reports and exports take it, without its image. Raises UnusableInputError."""
    return CalibratedImage(ObservedView("", inputs_of(view).observations), view)


def inputs_of(view: BeadView) -> CalibrationInputs:
    """Return what a view was calibrated from. Raises UnusableInputError where it was not made by `calibrate`."""
    if view.inputs is None:
        raise UnusableInputError(f"view {view.name} was not made by `calibrate`, so it cannot be saved; calibrate it")
    return view.inputs


def written(view: BeadView) -> dict[str, Any]:
    """Return the document of a view. Raises UnusableInputError where it was not made by `calibrate`."""
    inputs = inputs_of(view)
    return {
        **view_document(as_image(view)),
        "made_from": {
            "observations": plain(inputs.observations),
            "frame": json.loads(inputs.frame.to_json()),
            "degree": inputs.degree,
            "plate": inputs.plate,
            "mirrored_display": view.mirrored_display,
            "c_arm": None if view.c_arm is None else plain(view.c_arm),
        },
    }


def view(given: dict[str, Any]) -> BeadView:
    """Return the view of a document, with the document's checks.

    Raises UnusableInputError where it comes out otherwise than the document states, and what `calibrate` raises.
    """
    made_from = given["made_from"]
    c_arm = made_from["c_arm"]
    out = calibrate(
        observations(made_from["observations"]),
        Frame.from_json(json.dumps(made_from["frame"]).encode()),
        method=given["method"],
        degree=made_from["degree"],
        plate=made_from["plate"],
        mirrored_display=made_from["mirrored_display"],
        c_arm=None if c_arm is None else CArm(**c_arm),
    )
    off_mm = float(np.linalg.norm(out.focal_point_mm - np.array(given["focal_point_mm"])))
    if not off_mm <= _SAME_MM or out.name != given["view"]:
        raise UnusableInputError(
            f"this version puts the focal point of view {out.name} {off_mm:.3f} mm from where the file has it; "
            "calibrate the image again"
        )
    return replace(out, checks=checks(given["checks"]))


def checks(given: list[dict[str, Any]]) -> tuple[Check, ...]:
    """Return the checks of a document."""
    return tuple(Check.of(one) for one in given)


def matrix_written(view: MatrixView) -> dict[str, Any]:
    """Return the document of a matrix's view, as the export to OpenCV writes it."""
    return opencv.document(Pinhole.of_matrix(view.matrix, view.name, covariance=view.covariance))


def matrix_view(given: dict[str, Any]) -> MatrixView:
    """Return the view of a document. Raises UnusableInputError."""
    return opencv.of_document(given, given["view"]).view()
