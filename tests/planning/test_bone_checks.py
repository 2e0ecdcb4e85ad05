"""A wire checked against the bone: side, order of its ends, tip below the head's surface, entry at the cortex."""

import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from sightline.common.checks import OF_BONE, Check, CheckCode, advised, failed
from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.planning import Aids, Circle, Line, MatchingCurve, Pick, Plan, Procedure, kind, plan
from sightline.planning.points.results import Verdict
from sightline.planning.procedures.procedure import shipped
from sightline.planning.verdict.bone_checks import judge_in_bone

from . import bone
from .standin import StandInView

VIEWS = bone.views()
# The tip 8.3 mm under the head's surface; that of `bone` lies 2 mm deeper.
WIRE_MM = np.stack([bone.ENTRY_MM, bone.END_MM + 2.0 * (bone.END_MM - bone.ENTRY_MM) / 88.0])
DOWN = {"right": 1.0, "left": -1.0}


def hip_screw_with(check: str, **limits: float) -> Procedure:
    """The hip screw with other limits of one check."""
    known = kind("hip-screw").document
    rules = [rule.model_copy(update=limits) if rule.check == check else rule for rule in known.checks]
    return Procedure.of(known.model_copy(update={"checks": tuple(rules)}))


def _one_curve(*_: object) -> MatchingCurve:
    """No curve is looked at here, and drawing one takes most of the time of a plan."""
    return bone.curve_once()


def _planned(
    wire_mm: np.ndarray,
    centre_mm: np.ndarray = bone.CENTRE_MM,
    side: str | None = "right",
    lesser_mm: np.ndarray | None = bone.LESSER_MM,
    radius_mm: float | None = bone.RADIUS_MM,
    aids: Aids | None = None,
    noise_px: np.ndarray | float = 0.0,
) -> Plan:
    """On a sphere for a head, as clicks on its rim show it; without other `aids` all of the bone is drawn."""
    uv = np.array([view.project(wire_mm) for view in VIEWS]) + noise_px
    drawn = aids or _all_drawn(centre_mm)
    if radius_mm is not None:
        drawn = replace(drawn, head=(_rim(VIEWS[0], centre_mm, radius_mm), _rim(VIEWS[1], centre_mm, radius_mm)))
    marks = None if lesser_mm is None else np.array([view.project(lesser_mm[None]) for view in VIEWS])
    names = () if lesser_mm is None else ("lesser-trochanter",)
    return plan(
        VIEWS, uv[:, 0], uv[:, 1], side=side, aids=drawn, landmarks_uv_px=marks, landmark_names=names, curve=_one_curve
    )


def _all_drawn(centre_mm: np.ndarray, entry_mm: np.ndarray = bone.ENTRY_MM) -> Aids:
    """Neck and shaft of a hip of any side, and the lateral cortex at the entry."""
    shaft = entry_mm + np.array([[-15.0, -5.0, 0.0], [-15.0, 5.0, 0.0]])
    neck = np.stack([entry_mm, centre_mm])
    return Aids(
        neck=(Line(VIEWS[0].project(neck)), Line(VIEWS[1].project(neck))),
        shaft=(Line(VIEWS[0].project(shaft)), Line(VIEWS[1].project(shaft))),
        cortex=Pick.free(VIEWS[0].project(entry_mm[None])[0]),
    )


def _rim(view: StandInView, centre_mm: np.ndarray, radius_mm: float) -> Circle:
    ray = centre_mm - view.focal_point_mm
    around = np.linalg.svd(ray[None])[2][1:]
    sine = radius_mm / np.linalg.norm(ray)
    turns = np.deg2rad([10.0, 75.0, 140.0, 210.0, 290.0])
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ around
    return Circle.through(view.project(centre_mm - sine**2 * ray + radius_mm * np.sqrt(1 - sine**2) * ring))


def _names(verdict: Verdict) -> set[str]:
    return {check.name for check in failed(verdict.checks)}


def _drawn_hips(count: int = 24) -> list[tuple[np.ndarray, np.ndarray, float, str]]:
    """Wire (2, 3), centre and radius of the head, side: hips of both sides, about as different as patients are."""
    rng, out = np.random.default_rng(21), []
    for k in range(count):
        side, radius = ("right", "left")[k % 2], rng.uniform(20.0, 26.0)
        angle, turn = np.deg2rad(rng.uniform(126.0, 142.0)), np.deg2rad(rng.uniform(-5.0, 25.0))
        along = np.array([-np.sin(angle) * np.cos(turn), np.cos(angle), np.sin(angle) * np.sin(turn)])
        along[1] *= DOWN[side]
        centre = rng.uniform(-8.0, 8.0, 3) - np.array([15.0, 15.0 * DOWN[side], 0.0])
        wire = np.stack([centre - rng.uniform(62.0, 82.0) * along, centre + (radius - rng.uniform(6.0, 9.0)) * along])
        out.append((wire, centre, radius, side))
    return out


def _lesser(wire_mm: np.ndarray, side: str) -> np.ndarray:
    return wire_mm[0] + np.array([-35.0, 5.0 * DOWN[side], -8.0])


def _said(verdict: Verdict, name: str) -> str:
    """The sentences of the failed checks of a name, which state no negative length: a person reads a direction."""
    said = " ".join(check.sentence for check in failed(verdict.checks) if check.name == name)
    assert not re.search(r"-\d", said)
    return said


def test_right_plans_are_go_and_none_is_when_its_points_are_exchanged_or_its_side_is_the_other():
    other = {"right": "left", "left": "right"}
    noise = np.random.default_rng(22)
    for wire, centre, radius, side in _drawn_hips():
        known = {"centre_mm": centre, "radius_mm": radius, "lesser_mm": _lesser(wire, side)}
        known["aids"] = _all_drawn(centre, wire[0])
        noise_px = noise.normal(0.0, 0.5, (2, 2, 2))
        right = _planned(wire, side=side, noise_px=noise_px, **known).verdict
        assert right.state == "go", failed(right.checks)
        exchanged = _planned(wire[::-1], side=side, noise_px=noise_px, **known).verdict
        assert exchanged.state == "no-go" and "entry and end" in _names(exchanged)
        assert "mm farther from the head's centre than" in _said(exchanged, "entry and end")
        wrong = _planned(wire, side=other[side], noise_px=noise_px, **known).verdict
        assert wrong.state == "no-go" and _names(wrong) == {"side"}
        assert "mm above it" in _said(wrong, "side")


def test_what_is_known_without_the_head_tells_an_exchange_too():
    """The landmark at the head's centre, where no outline was drawn: incomplete, and wrong where exchanged."""
    marks = np.array([view.project(np.stack([bone.CENTRE_MM, bone.LESSER_MM])) for view in VIEWS])
    uv = np.array([view.project(np.stack([bone.ENTRY_MM, bone.END_MM])) for view in VIEWS])
    names = ("head-centre", "lesser-trochanter")
    known = {"side": "right", "landmarks_uv_px": marks, "landmark_names": names}
    right = plan(VIEWS, uv[:, 0], uv[:, 1], **known).verdict
    assert right.state == "incomplete"
    assert {check.name for check in right.unmade} >= {"head", "tip-apex distance", "wire to shaft", "entry at cortex"}
    assert sum("The head is not drawn" in said for said in right.missing) == 1  # asked for once
    exchanged = plan(VIEWS, uv[:, 1], uv[:, 0], **known).verdict
    assert exchanged.state == "no-go" and "entry and end" in _names(exchanged)


@pytest.mark.parametrize("short_mm", [-4.0, -0.6, 0.1, 2.5, 8.0, 40.0])
def test_the_tip_must_stay_under_the_heads_surface_by_more_than_its_error(short_mm: float):
    along = (bone.END_MM - bone.ENTRY_MM) / np.linalg.norm(bone.END_MM - bone.ENTRY_MM)
    through = bone.CENTRE_MM + 3.0 * np.array([0.0, 0.0, 1.0])  # not quite central
    inside = np.sqrt(bone.RADIUS_MM**2 - np.linalg.norm(np.cross(through - bone.CENTRE_MM, along)) ** 2)
    end = through + (inside - (through - bone.CENTRE_MM) @ along - short_mm) * along
    wire = np.stack([through - 74.0 * along, end])
    verdict = _planned(wire, lesser_mm=_lesser(wire, "right"), aids=_all_drawn(bone.CENTRE_MM, wire[0])).verdict
    (check,) = (check for check in verdict.checks if check.name == "tip in head")
    depth = bone.RADIUS_MM - np.linalg.norm(end - bone.CENTRE_MM)
    assert check.figure == pytest.approx(depth, abs=0.02)
    assert 0.12 < check.limit < 0.2  # clicks of 0.5 px are 0.1 mm here
    assert check.passed == (depth > check.limit)
    assert verdict.go == (short_mm == 8.0)  # the window is 5 to 10 mm
    window = {"tip to bone nearest", "tip to bone along wire", "tip-apex distance"} & _names(verdict)
    assert bool(window) == (short_mm != 8.0)
    if not check.passed:
        where = f"{abs(depth):.1f} mm {'under' if depth > 0 else 'beyond'} the nearest surface"
        assert f"{check.limit:.1f} mm" in check.sentence and where in check.sentence


@pytest.mark.parametrize("inside_mm", [0.0, 16.0, 25.0, 45.0])
def test_an_entry_inside_the_neck_is_no_go(inside_mm: float):
    along = (bone.END_MM - bone.ENTRY_MM) / np.linalg.norm(bone.END_MM - bone.ENTRY_MM)
    wire = np.stack([bone.ENTRY_MM + inside_mm * along, WIRE_MM[1]])
    by_lesser = _planned(wire, aids=replace(_all_drawn(bone.CENTRE_MM), cortex=None)).verdict
    assert by_lesser.state == ("incomplete" if inside_mm == 0.0 else "no-go")
    assert "entry at cortex" in {check.name for check in by_lesser.unmade}
    by_cortex = _planned(wire, lesser_mm=None, noise_px=0.0)
    assert ("entry at cortex" in _names(by_cortex.verdict)) == (inside_mm > 0.0)
    assert "entry at cortex" not in {check.name for check in by_cortex.verdict.unmade}
    assert sum("an image may not show the trochanter" in said for said in by_cortex.sentences()) == 2


def test_a_wire_that_no_plate_or_screw_fits_is_no_go():
    uv = bone.pixels(bone.views())
    drawn = replace(bone.aids(uv), neck=None, calcar=None, cortex=None)
    steep = np.stack([bone.CENTRE_MM + np.array([30.0, 75.0, -4.0]), bone.CENTRE_MM - np.array([4.0, 10.0, 0.0])])
    verdict = _planned(steep, radius_mm=None, lesser_mm=steep[0] - np.array([30.0, 0.0, 0.0]), aids=drawn).verdict
    (check,) = (check for check in verdict.checks if check.name == "wire to shaft")
    assert check.figure > check.limit == 155.0
    assert not check.passed
    length = _planned(WIRE_MM)
    short = plan(
        bone.views(),
        *np.swapaxes([view.project(np.stack([bone.ENTRY_MM, bone.END_MM])) for view in bone.views()], 0, 1),
        procedure=hip_screw_with("wire length", high=80.0),
    )
    (check,) = (check for check in short.verdict.checks if check.name == "wire length")
    assert (check.limit, check.passed) == (80.0, False)
    assert length.verdict.go


@pytest.mark.parametrize(("name", "side"), [("tip-apex distance", 1), ("tip to bone nearest", -1)])
def test_a_value_nearer_to_its_limit_than_its_error_is_told_on_which_side_the_limit_lies(name: str, side: int):
    """Such a value fails although it lies within the limit, so the limit must say which side of it is right."""
    made = _planned(WIRE_MM)
    (check,) = (check for check in made.verdict.checks if check.name == name)
    limit = check.figure + side * check.error_95 / 2
    rules = hip_screw_with(name, **({"high": limit} if side > 0 else {"low": limit})).checks
    (check,) = (check for check in judge_in_bone(made.anatomy, rules, "right", {}).checks if check.name == name)
    assert not check.passed
    assert check.limit_text.startswith("at most" if side > 0 else "at least")
    assert check.bounds_below == (side < 0)


def test_outlines_that_fit_no_head_are_no_go_and_not_merely_missing():
    verdict = _planned(WIRE_MM, radius_mm=37.0).verdict
    assert verdict.state == "no-go"
    (check,) = (check for check in failed(verdict.checks) if check.name == "head")
    assert "do not fit a sphere" in check.sentence


def test_outlines_of_two_spheres_are_no_go():
    """Their radii, corrected for magnification, differ by 1.5 mm; their centres agree."""
    views = bone.views()
    head = tuple(
        _rim(view, bone.CENTRE_MM, bone.RADIUS_MM + more) for view, more in zip(views, (0.75, -0.75), strict=True)
    )
    drawn = replace(_all_drawn(bone.CENTRE_MM), head=head)
    assert _names(_planned(WIRE_MM, radius_mm=None, aids=drawn).verdict) == {"head agreement"}


def test_missing_and_wrong_together_are_no_go_and_both_are_said():
    wanting, wrong = (
        Check(name, False, None, None, "", f"{name}.", missing=name == "side") for name in ("side", "gap")
    )
    right = Check("error known", True, None, None, "", "Known.")
    assert Verdict((right,)).state == "go"
    assert Verdict((right, wanting)).state == "incomplete"
    both = Verdict((right, wanting, wrong))
    assert (both.state, both.missing, both.go) == ("no-go", ("side.",), False)


def test_the_first_advice_is_about_the_bone():
    """A wire through the joint, whose picks also miss each other by 20 px."""
    wrong = _planned(
        np.stack([bone.ENTRY_MM, WIRE_MM[1] - 0.2 * (bone.ENTRY_MM - WIRE_MM[1])]), side=None, noise_px=20.0
    )
    codes = [check.code for check in advised(wrong.verdict.checks)]
    of_bone = [code in OF_BONE for code in codes]
    wanted = [code for code in codes if code == CheckCode.SIDE]
    assert codes[0] == CheckCode.TIP_IN_HEAD and CheckCode.GAP in codes and codes[-1:] == wanted
    assert of_bone[: of_bone.index(False)] and not any(of_bone[of_bone.index(False) : -1])
    judged = {rule.code or CheckCode.ENTRY_AT_CORTEX for one in shipped().values() for rule in one.checks}
    assert judged - OF_BONE == {CheckCode.VIEW_DIRECTIONS, CheckCode.ANGLE_BETWEEN_VIEWS}  # of the images


@pytest.mark.parametrize("names", [("patella",), ("lesser-trochanter", "head-centre"), ("", "")])
def test_landmarks_have_names_of_the_kinds_once_each(names: tuple[str, ...]):
    uv = np.array([view.project(np.stack([bone.ENTRY_MM, bone.END_MM])) for view in VIEWS])
    mark = np.array([view.project(bone.LESSER_MM[None]) for view in VIEWS])
    with pytest.raises(UnusableInputError, match="landmark"):
        plan(VIEWS, uv[:, 0], uv[:, 1], landmarks_uv_px=mark, landmark_names=names)


def test_how_far_a_point_may_be_wrong_along_its_line_of_sight_is_what_the_checks_let_pass():
    """The end moved along either view's line of sight by a little less than is stated is still GO, by more NO-GO in at
    least one way; the entry likewise. A wire without a bone has nothing that would notice."""
    views, wire = bone.views(), WIRE_MM
    made = _planned(wire)
    assert made.verdict.go
    for point, reach in enumerate(made.noticed_mm):
        assert reach is not None and 1.0 < reach < 50.0
        passes = []
        for view in views:
            away = (wire[point] - view.focal_point_mm) / np.linalg.norm(wire[point] - view.focal_point_mm)
            for along in (away, -away):
                moved = wire.copy()
                moved[point] += (reach + 0.3) * along
                near = moved.copy()
                near[point] -= 0.9 * along
                with suppress(OutsideRegionError):  # which shows it, too
                    assert _planned(moved).verdict.state == "no-go"
                    passes.append(_planned(near).verdict.state != "no-go")
        assert any(passes)
    assert f"of the entry point up to {made.noticed_mm[0]:.1f} mm, of the end point up to" in made.unnoticed
    uv = np.array([view.project(wire) for view in views])
    free = plan(views, uv[:, 0], uv[:, 1], procedure="free-wire", curve=_one_curve)
    assert free.noticed_mm == (None, None)
    assert "of the entry point however large, of the end point however large" in free.unnoticed
