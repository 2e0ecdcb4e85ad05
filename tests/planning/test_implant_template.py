"""The implant's outline in an image: where it ends, how wide it is, where its thread begins."""

import json

import numpy as np
import pytest

from sightline.calibration import CalibratedView
from sightline.planning import Procedure, Trajectory, kind, reconstruct
from sightline.planning.points.curve import corridor
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import copy_text, document_from_json
from sightline.planning.verdict.implant import Template, template

from . import bone

HIP_SCREW = kind("hip-screw").document


def _trajectory(end_mm: np.ndarray = bone.END_MM) -> Trajectory:
    """A wire from the entry point; by default 87.6 mm long, between two lengths of the catalogue."""
    points = np.stack([bone.ENTRY_MM, end_mm])
    return Trajectory(reconstruct(bone.views(), np.array([view.project(points) for view in bone.views()])))


def _along(length_mm: float) -> np.ndarray:
    """The end of a wire of this length."""
    along = bone.END_MM - bone.ENTRY_MM
    return bone.ENTRY_MM + length_mm * along / np.linalg.norm(along)


def _drawn(view: CalibratedView, path: Trajectory, document: ProcedureDocument = HIP_SCREW) -> Template | None:
    """The outline of the implant over a wire of 2.5 mm."""
    return template(corridor(view, path), path.length_mm, document)


def _without(*names: str, **catalogue: object) -> ProcedureDocument:
    """The hip screw's file without these entries, and with others in its catalogue."""
    given = json.loads(copy_text("hip-screw", "mine"))
    given["checks"] = [one for one in given["checks"] if one["check"] != "wire in neck"]
    for name in names:
        given.pop(name)
    given.get("catalogue", {}).update(catalogue)
    return Procedure.of(document_from_json(json.dumps(given))).document


@pytest.mark.parametrize("which", [0, 1])
def test_the_outline_ends_at_its_own_length_and_is_as_wide_as_the_implant(which: int) -> None:
    """Fails for an outline as long as the wire, one that ends at the wire's tip, or one of the wire's width."""
    view, path = bone.views()[which], _trajectory()
    made = _drawn(view, path)
    assert made is not None and made.thread is not None
    assert made.length_mm == 5 * np.floor(path.length_mm / 5) < path.length_mm - 1.0
    places = path.entry_mm + np.array([[0.0], [made.length_mm - 22.0], [made.length_mm]]) * path.direction
    # 0.01 px: a cubic between stations 5 mm apart; a straight line between them is off by 0.06 px along the wire.
    np.testing.assert_allclose(made.uv_px[[0, made.thread, -1]], view.project(places), atol=0.01)
    ray = places - view.focal_point_mm
    side = np.cross(ray, path.direction)
    edge = view.project(places + 6.25 * side / np.linalg.norm(side, axis=1, keepdims=True))
    across = np.linalg.norm(edge - view.project(places), axis=1)
    # 3 %: the part of the offset that runs along the axis in a view with distortion
    np.testing.assert_allclose(made.half_px[[0, made.thread, -1]], across, rtol=0.03)


def test_no_outline_is_drawn_where_none_fits_or_its_size_is_not_known() -> None:
    view = bone.views()[0]
    assert _drawn(view, _trajectory(_along(49.0))) is None  # the shortest has 50 mm
    assert _drawn(view, _trajectory(), kind("distal-interlocking").document) is None  # longer than the wire
    assert _drawn(view, _trajectory(), _without("catalogue")) is None
    assert _drawn(view, _trajectory(), _without("corridor", diameters_mm=[6.5, 7.3])) is None  # which of them?
    only = _drawn(view, _trajectory(), _without("corridor", diameters_mm=[7.3]))
    assert only is not None and only.diameter_mm == 7.3


def test_an_implant_without_a_thread_has_an_outline_alone() -> None:
    made = _drawn(bone.views()[0], _trajectory(), _without(thread_mm=None))
    assert made is not None and made.thread is None
