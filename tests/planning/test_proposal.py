"""The proposed wire: through the head's centre at its angle, into the cortex; refused with the reason."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import ReconstructionRefusedError
from sightline.planning import Line, Pick, ProposalRule, kind, locate, plan, propose
from sightline.planning.bone.aids import Aids

from . import bone
from .standin import StandInView, pair

VIEWS = pair()


def _proposed(aids: Aids | None = None, side: str = "right", rule: ProposalRule | None = None):
    aids = bone.aids(bone.pixels(VIEWS)) if aids is None else aids
    return VIEWS, propose(VIEWS, locate(VIEWS, aids), side, rule)


@pytest.mark.parametrize("with_neck", [False, True])
@pytest.mark.parametrize("rule", [ProposalRule(), ProposalRule(np.deg2rad(130.0), 6.0)])
def test_the_proposal_is_what_the_rule_says(with_neck, rule):
    drawn = bone.aids(bone.pixels(pair()))
    views, made = _proposed(drawn if with_neck else replace(drawn, neck=None), rule=rule)
    wire = made.end_mm - made.entry_mm
    length = np.linalg.norm(wire)
    wire /= length
    assert np.arccos(wire @ bone.SHAFT) == pytest.approx(rule.angle_rad, abs=1e-7)
    np.testing.assert_allclose(np.cross(bone.CENTRE_MM - made.entry_mm, wire), 0.0, atol=1e-5)
    assert np.linalg.norm(made.end_mm - bone.CENTRE_MM) == pytest.approx(
        bone.RADIUS_MM - rule.under_surface_mm, abs=1e-5
    )
    off_axis = np.cross(made.entry_mm - bone.ON_SHAFT_MM, bone.SHAFT)
    assert np.linalg.norm(off_axis) == pytest.approx(14.8, abs=0.01)  # the cortex that the click touches
    assert made.entry_mm[0] > bone.ON_SHAFT_MM[0]  # the lateral one
    turned = np.cross(wire, bone.SHAFT) / np.linalg.norm(np.cross(wire, bone.SHAFT))
    across = np.cross(bone.NECK, bone.SHAFT) / np.linalg.norm(np.cross(bone.NECK, bone.SHAFT))
    assert (abs(turned @ across) > 1 - 1e-9) == with_neck
    again = plan(views, made.entry_uv_px, made.end_uv_px, procedure=kind("free-wire"))
    np.testing.assert_allclose(again.trajectory.entry_mm, made.entry_mm, atol=1e-6)
    np.testing.assert_allclose(again.trajectory.end_mm, made.end_mm, atol=1e-6)
    assert f"{length:.0f} mm long" in made.sentence


def _pixel(xyz_mm: np.ndarray) -> Pick:
    return Pick.free(pair()[0].project(xyz_mm[None])[0])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"head": None}, "the head is not drawn"),
        ({"shaft": None}, "the shaft axis is not drawn"),
        ({"cortex": None}, "the lateral cortex is not clicked"),
        ({"cortex": "medial"}, "on the head's side"),
        ({"cortex": "near"}, "lies 3 mm from"),
        ({"shaft": "through the head"}, "from the shaft's axis"),
        ({"neck": "backwards"}, "away from the head's centre"),
    ],
)
def test_impossible_proposals_are_refused_with_the_reason(change, why):
    drawn = bone.aids(bone.pixels(VIEWS))
    ((name, what),) = change.items()
    lateral, medial = (bone.ON_SHAFT_MM + 5.0 * bone.SHAFT + np.array([x, 0.0, 0.0]) for x in (3.0, -12.0))
    new = {
        None: None,
        "medial": _pixel(medial),
        "near": _pixel(lateral),
        "through the head": _lines(VIEWS, bone.CENTRE_MM + np.array([3.0, 0.0, 1.0]), bone.SHAFT),
        "backwards": _lines(VIEWS, bone.ON_NECK_MM, np.array([-0.35, -0.45, -0.82])),
    }[what]
    with pytest.raises(ReconstructionRefusedError, match=why):
        _proposed(replace(drawn, **{name: new}))


def _lines(views: list[StandInView], on_mm: np.ndarray, along: np.ndarray) -> tuple[Line, Line]:
    first, second = (Line(bone.drawn_line(view, on_mm, along, (-12.0, 14.0))) for view in views)
    return first, second


def test_the_wrong_side_is_refused():
    """Else a wire would be proposed that runs from above into the head, as long and as steep as a good one."""
    with pytest.raises(ReconstructionRefusedError, match="above the head of a left hip"):
        _proposed(side="left")
    with pytest.raises(ReconstructionRefusedError, match="too small for a tip"):
        _proposed(rule=ProposalRule(under_surface_mm=25.0))


def test_a_kinds_limits_judge_its_plan():
    near, far = np.array([10.0, 20.0, 3.0]), np.array([-1.0, 20.5, 2.0])  # two holes of a nail
    uv = np.array([view.project(np.stack([near, far])) for view in VIEWS])
    strict, loose = (
        {c.name: c for c in plan(VIEWS, uv[:, 0], uv[:, 1], procedure=kind(key)).verdict.checks}
        for key in ("hip-screw", "interlocking")
    )
    assert strict["direction error"].limit == pytest.approx(0.6)
    assert loose["direction error"].limit == pytest.approx(5.19, abs=0.01)
    assert loose["entry error"].limit == 0.5
    assert strict["direction error"].passed < loose["direction error"].passed
