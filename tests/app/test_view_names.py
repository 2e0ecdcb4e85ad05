"""What a page calls the images of a procedure, and the aids that its checks still need."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.planning.other_bones import PROCEDURES, drawn

from sightline.app import texts
from sightline.app.drawing.space import axis_objects, side_objects
from sightline.app.panels.steps import aid_labels, needed_aids
from sightline.app.plan.decisions import Decisions
from sightline.app.texts import image_label, image_name, image_short, in_image
from sightline.common.checks import Check
from sightline.planning.points.results import Verdict
from sightline.planning.procedures import kind as kind_of

SACRAL = "iliosacral-screw"


def test_an_image_has_the_name_of_its_view_in_the_procedure() -> None:
    """Fails for an outlet view that is called lateral."""
    assert [image_label(one, SACRAL) for one in ("pa", "check-lateral", "oblique")] == [
        "Inlet image",
        "Outlet check image",
        "Oblique image",
    ]
    assert image_name("shot-lateral", SACRAL) == "outlet shot" and image_short("pa", SACRAL) == "inlet"
    assert (in_image("lateral", SACRAL), in_image("check-pa", SACRAL)) == ("OUTLET", "INLET CHECK")
    assert image_label("check-lateral", "hip-screw") == "Lateral check image" and in_image("pa", "hip-screw") == "PA"


def test_a_check_of_one_view_names_the_view_of_the_procedure() -> None:
    check = Check("bead count", True, 16.0, 6.0, "beads", "16 balls of the solid are used.").of_view("lateral")
    assert texts.sentence(check, SACRAL) == "Outlet: 16 balls of the solid are used."
    assert texts.sentence(check, "hip-screw") == "Lateral: 16 balls of the solid are used."
    other = replace(check, sentence="The lateral cortex is clicked.", view="")
    assert texts.sentence(other, SACRAL) == other.sentence


def _unmade(*names: str) -> Verdict:
    return Verdict(tuple(Check(name, False, None, None, "", f"{name}.", missing=True) for name in names))


def _known(bone: str, *, without: tuple[str, ...] = (), side: Any = "right") -> Any:
    """A plan on one of the twin's bones, with all aids drawn but some."""
    one = drawn(bone)
    found = one.found(one.wire_mm, {key: uv for key, uv in one.uv_px.items() if key not in without}, 0.5)
    kind = PROCEDURES[bone]
    return SimpleNamespace(kind=kind_of(kind), anatomy=found, decisions=Decisions(kind=kind, side=side))


@pytest.mark.parametrize(
    ("bone", "without", "unmade", "needed"),
    [
        ("pelvis", ("s1-corridor",), ("wire in sacral corridor", "side"), ("s1-corridor",)),
        ("vertebra", ("pedicle", "upper-endplate"), ("wire in pedicle", "tip to endplates"), None),
        ("vertebra", ("upper-endplate",), ("view directions",), ("upper-endplate",)),
        ("growing-femur", ("growth-plate",), ("wire to growth plate", "tip beyond growth plate"), ("growth-plate",)),
        ("vertebra", (), ("wire in pedicle",), ()),  # it is drawn: another input is missing
    ],
)
def test_the_page_leads_to_the_aids_that_checks_lack(
    bone: str, without: tuple[str, ...], unmade: tuple[str, ...], needed: tuple[str, ...] | None
) -> None:
    """Fails for a page that leads only to a head, and leaves a spine without the next thing to do."""
    known = _known(bone, without=without)
    assert needed_aids(known, _unmade(*unmade)) == (without if needed is None else needed)


def test_a_side_that_is_not_confirmed_needs_no_aid() -> None:
    known = _known("vertebra", without=("upper-endplate",), side=None)
    assert needed_aids(known, _unmade("side", "view directions")) == ()


def test_an_aid_is_named_as_in_the_checklist() -> None:
    """Fails for its key, "upper-endplate"."""
    kind = kind_of("pedicle-screw")
    assert aid_labels(kind, ("upper-endplate", "front")) == ("Upper end plate", "Front of the vertebral body")


def test_beside_a_block_no_axis_is_called_by_the_patient() -> None:
    """A block lies beside the patient in any way: fails where +Y is called the feet."""
    assert [one["kind"] for one in axis_objects()] == ["axes"]
    assert {one.get("text") for one in side_objects("right", np.zeros(3))} >= {"cranial", "caudal", "lateral"}
