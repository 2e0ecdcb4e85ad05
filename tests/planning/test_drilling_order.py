"""The proposed order of drilling: the wires that hide beads come last, and the file's order is kept."""

import json

import numpy as np

from sightline.frame import Frame
from sightline.from_images.pipeline import DATUM_BEADS, propose_order
from sightline.planning import WireLines
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import copy_text, document_from_json

from .bone import views

GAMMA = Frame.load("gamma")


def procedure(*order: str) -> ProcedureDocument:
    """The three cannulated wires, with this order of drilling only."""
    given = json.loads(copy_text("cannulated-hip-screws", "mine"))
    given["relations"] = [{"relation": "order", "wires": list(order), "source": "test"}] if order else []
    return document_from_json(json.dumps(given))


def wire_at(aside_mm: float) -> np.ndarray:
    """A wire across the frame as in a hip, this far beside its middle."""
    return np.array([[37.3, 33.1, -6.0], [-31.2, -34.4, 8.3]]) + aside_mm * np.array([0.6, -0.6, 0.5])


def covered(*wires: np.ndarray) -> float:
    """The beads in the shadows of wires of 2.8 mm, a datum as DATUM_BEADS: by points along the wires."""
    total = 0.0
    for axis, view in zip((2, 0), views(), strict=True):
        focal = view.focal_point_mm
        for bead in GAMMA.view(view.name).fiducials:
            hidden = False
            for entry, end in wires:
                way = (end - entry) / np.linalg.norm(end - entry)
                on = entry + np.arange(-100.0, np.linalg.norm(end - entry), 0.1)[:, None] * way
                larger = (bead.xyz_mm[axis] - focal[axis]) / (on[:, axis] - focal[axis])
                shadow = focal + larger[:, None] * (on - focal)
                off = np.linalg.norm(shadow - bead.xyz_mm, axis=1)
                hidden |= bool((off < bead.diameter_mm / 2 + 1.4 * larger).any())
            total += hidden * (DATUM_BEADS if bead.datum else 1.0)
    return total


KEYS = ("inferior", "anterior", "posterior")
ENDS = np.array([wire_at(aside) for aside in (0.0, 12.0, -18.0)])
WIRES = WireLines(KEYS, ENDS, None)


def test_the_wires_that_hide_beads_are_drilled_last():
    """The file lists the one that hides most first."""
    assert [covered(wire) for wire in ENDS] == [27.0, 19.0, 4.0]
    order = propose_order(WIRES, procedure(), views(), GAMMA)
    assert order.keys == ("posterior", "anterior", "inferior")
    assert order.hidden == (0.0, covered(ENDS[2]), covered(ENDS[2], ENDS[1]))
    assert order.sentence({key: f"{key} wire" for key in KEYS}).startswith("Drill the posterior wire, then the ant")


def test_the_order_of_the_file_is_kept():
    order = propose_order(WIRES, procedure("inferior", "posterior"), views(), GAMMA)
    assert order.keys == ("inferior", "posterior", "anterior")  # the posterior wire hides less than the anterior one
    assert propose_order(WIRES, procedure(*KEYS), views(), GAMMA).keys == KEYS


def test_wires_in_the_bone_hide_beads_from_the_first_check_on():
    order = propose_order(WIRES, procedure(), views(), GAMMA, placed=["inferior"])
    assert order.keys == ("posterior", "anterior")
    assert order.hidden == (covered(ENDS[0]), covered(ENDS[0], ENDS[2]))


def test_beads_outside_the_view_are_not_hidden():
    far = WIRES.ends_mm + np.array([0.0, 400.0, 0.0])
    assert propose_order(WireLines(KEYS, far, None), procedure(), views(), GAMMA).hidden == (0.0, 0.0, 0.0)
