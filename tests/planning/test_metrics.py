"""The metrics of an implant against their definitions, on a bone of known form; a left hip is a mirrored right one."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.planning import Aids, locate, metrics

from . import bone
from .standin import StandInView, pair

VIEWS = pair()

NAMES = (
    "wire length",
    "wire to shaft",
    "neck-shaft angle",
    "neck version",
    "tip-apex distance",
    "calcar tip-apex distance",
    "tip to bone along wire",
    "tip to bone nearest",
    "wire off neck axis",
    "position AP",
    "position lateral",
)


def _metrics(views: list[StandInView], side: str = "right", **change: np.ndarray):
    uv = bone.pixels(views)
    if "wire_mm" in change:
        uv["wire"] = [view.project(change["wire_mm"]) for view in views]
    return {metric.name: metric for metric in metrics(locate(views, bone.aids(uv), bone.picks(uv)), side)}


def _flat(way: np.ndarray, view: StandInView) -> float:
    """Length across the ray through the head's centre."""
    beam = bone.CENTRE_MM - view.focal_point_mm
    return float(np.linalg.norm(np.cross(way, beam)) / np.linalg.norm(beam))


def test_metrics_follow_their_definitions():
    found = _metrics(VIEWS)
    assert tuple(found) == NAMES
    wire = bone.END_MM - bone.ENTRY_MM
    length = np.linalg.norm(wire)
    wire = wire / length
    apex = bone.CENTRE_MM + bone.RADIUS_MM * bone.NECK
    tip = bone.END_MM - bone.CENTRE_MM
    assert found["wire length"].value == pytest.approx(length, abs=1e-6)
    assert found["wire to shaft"].value == pytest.approx(np.rad2deg(np.arccos(wire @ bone.SHAFT)), abs=1e-6)
    assert found["neck-shaft angle"].value == pytest.approx(np.rad2deg(bone.NECK_SHAFT_RAD), abs=1e-6)
    assert found["neck version"].value == pytest.approx(np.rad2deg(bone.VERSION_RAD), abs=1e-6)
    tad = sum(_flat(bone.END_MM - apex, view) for view in VIEWS)
    assert found["tip-apex distance"].value == pytest.approx(tad, abs=1e-6)
    assert found["tip to bone nearest"].value == pytest.approx(bone.RADIUS_MM - np.linalg.norm(tip), abs=1e-6)
    neck = locate(VIEWS, bone.aids(bone.pixels(VIEWS))).neck
    assert neck is not None
    off = neck.ends_mm.mean(axis=0) - bone.ENTRY_MM
    assert found["wire off neck axis"].value == pytest.approx(np.linalg.norm(np.cross(off, wire)), abs=1e-6)
    ahead = found["tip to bone along wire"].value
    assert np.linalg.norm(tip + ahead * wire) == pytest.approx(bone.RADIUS_MM, abs=1e-6)
    assert ahead > 0
    assert all(figure.sd > 0 and figure.source for figure in found.values())


def test_the_calcar_line_leaves_the_head_where_it_should():
    """A point on the head's rim in the PA view, from the calcar along the neck: its distance to the tip."""
    beam = bone.CENTRE_MM - VIEWS[0].focal_point_mm
    beam /= np.linalg.norm(beam)
    flat = np.eye(3) - np.outer(beam, beam)
    along = flat @ bone.NECK / np.linalg.norm(flat @ bone.NECK)
    start = flat @ (bone.calcar_mm() - bone.CENTRE_MM)
    steps = np.linspace(0.0, 120.0, 1_200_001)
    inside = np.linalg.norm(start + steps[:, None] * along, axis=1) < bone.RADIUS_MM
    leaves = start + steps[np.flatnonzero(inside)[-1]] * along
    ap = np.linalg.norm(flat @ (bone.END_MM - bone.CENTRE_MM) - leaves)
    apex = bone.CENTRE_MM + bone.RADIUS_MM * bone.NECK
    expected = ap + _flat(bone.END_MM - apex, VIEWS[1])
    # 1 % of the way along the beam to the calcar's line of sight, which is not quite that to the centre.
    assert _metrics(VIEWS)["calcar tip-apex distance"].value == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize(
    ("moved_mm", "ap", "lateral"),
    [
        ([0.0, -12.0, 0.0], "superior", "centre"),
        ([0.0, 14.0, 0.0], "inferior", "centre"),
        ([0.0, 0.0, 12.0], "centre", "anterior"),
        ([0.0, 0.0, -12.0], "centre", "posterior"),
        ([0.0, 1.0, 1.0], "centre", "centre"),
    ],
)
def test_thirds_of_the_head(moved_mm, ap, lateral):
    found = _metrics(pair(), wire_mm=np.stack([bone.ENTRY_MM, bone.END_MM]) + np.array(moved_mm))
    assert (found["position AP"].zone, found["position lateral"].zone) == (ap, lateral)
    assert found["position AP"].within == (ap == "centre")
    assert ap in found["position AP"].sentence


def test_a_left_hip_mirrors_a_right_one():
    """Mirrored at Y = 0: every metric is unchanged, given the side."""
    mirror = np.diag([1.0, -1.0, 1.0])
    mirrored = [
        replace(
            view,
            focal_point_mm=mirror @ view.focal_point_mm,
            plane=replace(view.plane, origin_mm=mirror @ view.plane.origin_mm, axes=view.plane.axes @ mirror),
        )
        for view in VIEWS
    ]
    uv = bone.pixels(VIEWS)
    right, left = (
        metrics(locate(each, bone.aids(uv), bone.picks(uv)), side)
        for each, side in ((VIEWS, "right"), (mirrored, "left"))
    )
    np.testing.assert_allclose([f.value for f in left], [f.value for f in right], atol=1e-9)
    assert [f.zone for f in left] == [f.zone for f in right]
    wrong = {f.name: f for f in metrics(locate(mirrored, bone.aids(uv), bone.picks(uv)), "right")}
    for name in ("wire to shaft", "neck-shaft angle", "neck version", "position AP"):  # else 53° and upside down
        assert wrong[name].value is None
        assert "above the head of a right hip" in wrong[name].sentence
    with pytest.raises(UnusableInputError, match="side"):
        metrics(locate(VIEWS, Aids()), "both")


def test_a_wire_outside_the_head_has_no_bone_ahead():
    found = _metrics(pair(), wire_mm=np.stack([bone.ENTRY_MM, bone.END_MM]) + np.array([0.0, 0.0, 24.5]))
    ahead = found["tip to bone along wire"]
    assert ahead.value is None
    assert ahead.within is None
    assert "outside the head" in ahead.sentence
    assert found["tip to bone nearest"].value < 0  # the tip is out


def test_what_is_not_drawn_is_absent_and_never_zero():
    uv = bone.pixels(VIEWS)
    drawn = bone.aids(uv)
    found = {f.name: f for f in metrics(locate(VIEWS, replace(drawn, neck=None), bone.picks(uv)), "right")}
    absent = {"neck-shaft angle", "neck version", "tip-apex distance", "calcar tip-apex distance"}
    for name, figure in found.items():
        assert (figure.value is None) == (name in absent)
        assert (figure.sd is None) == (name in absent)
    assert "draw a line along it" in found["tip-apex distance"].sentence
    assert all(f.value is None for f in metrics(locate(VIEWS, Aids()), "right"))


def test_recommended_ranges():
    found = _metrics(pair())
    assert (found["tip-apex distance"].low, found["tip-apex distance"].high) == (10.0, 25.0)
    assert found["tip-apex distance"].within
    assert found["tip to bone nearest"].within is False  # 10.3 mm
    assert found["wire length"].within is None
