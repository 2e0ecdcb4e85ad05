"""Kinds of trajectory as data: the points to pick, the aids to draw, the limits."""

from dataclasses import dataclass

import numpy as np

from sightline.checks import Limits
from sightline.errors import UnusableInputError
from sightline.planning.bone_checks import HEAD_CENTRE, LESSER, BoneRule
from sightline.planning.proposal import ProposalRule


@dataclass(frozen=True)
class PlanInput:
    """One input of a plan that a person gives: `key` for files and options, `name` and `sentence` for display."""

    key: str
    name: str
    sentence: str


@dataclass(frozen=True)
class Procedure:
    """A procedure: the kind of trajectory that it asks for.

    `points`: entry and end, in this order; `landmarks`: picked freely in both views; `aids`: useful fields of `Aids`;
    `wire_mm`: diameter of the wire or drill; `limits` and their `limits_source`; `bone`: the rule for the wire's place
    in the bone, which needs the side and some of landmarks and aids, or None; `proposal`: the rule for proposing a
    wire, or None.
    """

    key: str
    name: str
    purpose: str
    points: tuple[PlanInput, PlanInput]
    landmarks: tuple[PlanInput, ...]
    aids: tuple[PlanInput, ...]
    wire_mm: float
    limits: Limits
    limits_source: str
    bone: BoneRule | None
    proposal: ProposalRule | None


_HIP_LANDMARKS = (
    PlanInput(HEAD_CENTRE, "centre of the head", "A sharp point of the head, the same in both images."),
    PlanInput(LESSER, "lesser trochanter", "The tip of the lesser trochanter."),
    # Two show a shift between the views; a check shot needs a third to show a rotation as well.
    PlanInput("greater-trochanter", "greater trochanter", "The tip of the greater trochanter."),
)
_HIP_AIDS = (
    PlanInput("head", "femoral head", "A circle over the head, or clicks on its rim, in both images."),
    PlanInput("shaft", "shaft axis", "A line along the middle of the shaft in both images."),
    PlanInput("neck", "neck axis", "A line along the middle of the neck in both images."),
    PlanInput("cortex", "lateral cortex", "One click on the lateral edge of the shaft in the PA image."),
    PlanInput("calcar", "calcar", "One click on the medial cortex of the neck in the PA image."),
)
# Nail holes of 5 mm and a 4 mm drill leave 0.5 mm to each side, at two holes about 11 mm apart [ours].
_HOLE_PLAY_MM, _HOLES_APART_MM = 0.5, 11.0

PROCEDURES: dict[str, Procedure] = {
    kind.key: kind
    for kind in (
        Procedure(
            "hip-screw",
            "hip screw",
            "The guide wire of a dynamic hip screw, from the lateral cortex through the neck into the head.",
            (
                PlanInput("entry", "entry point", "Where the wire enters the lateral cortex."),
                PlanInput("end", "end point", "Where its tip ends in the head, 5 to 10 mm under the subchondral bone."),
            ),
            _HIP_LANDMARKS,
            _HIP_AIDS,
            wire_mm=2.5,  # physics.md, Planning figures
            limits=Limits(),
            limits_source="what the paper reached with its robot: 1 mm and 0.6°",
            bone=BoneRule(),
            proposal=ProposalRule(),
        ),
        Procedure(
            "interlocking",
            "interlocking holes",
            "A drill through a pair of holes of a nail, along their common axis.",
            (
                PlanInput("entry", "near hole", "The centre of the hole on the side where the drill enters."),
                PlanInput("end", "far hole", "The centre of the hole on the other side of the nail."),
            ),
            (
                PlanInput("nail-tip", "tip of the nail", "The end of the nail."),
                PlanInput("other-hole", "centre of another hole", "A hole that is not drilled now, or a sharp edge."),
            ),
            (),
            wire_mm=4.0,
            limits=Limits(
                _HOLE_PLAY_MM,
                float(np.arctan2(2 * _HOLE_PLAY_MM, _HOLES_APART_MM)),
                beyond_mm=15.0,  # to the far cortex [ours]
            ),
            limits_source="a 4 mm drill in two 5 mm holes 11 mm apart",
            bone=None,
            proposal=None,
        ),
        Procedure(
            "free-wire",
            "free wire",
            "Any straight wire from one point to another.",
            (
                PlanInput("entry", "entry point", "Where the wire enters the bone."),
                PlanInput("end", "end point", "Where its tip ends."),
            ),
            (
                PlanInput("landmark-1", "first landmark", "A sharp point of the bone that both images show."),
                PlanInput("landmark-2", "second landmark", "Another, away from the first."),
            ),
            (),
            wire_mm=2.5,
            limits=Limits(),
            limits_source="what the paper reached with its robot: 1 mm and 0.6°",
            bone=None,
            proposal=None,
        ),
    )
}


def kind(key: str) -> Procedure:
    """Return the kind of trajectory of this key. Raises UnusableInputError."""
    if key not in PROCEDURES:
        raise UnusableInputError(f"unknown kind of trajectory {key!r}; choose one of {', '.join(PROCEDURES)}")
    return PROCEDURES[key]
