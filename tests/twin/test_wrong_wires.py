"""Wires that are wrong by a stated amount."""

import numpy as np
import pytest

from sightline.errors import SetUpError
from sightline.twin.anatomy.bone_model import CORTEX, FAR, wrong_wires
from sightline.twin.scenes.bone_scene import BONES

KINDS = {"vertebra": {FAR, CORTEX, "into the canal"}, "growing-femur": {FAR, CORTEX}}


@pytest.mark.parametrize(
    ("name", "beyond_mm"), [pytest.param("vertebra", 1.5, marks=pytest.mark.slow), ("growing-femur", 4.0)]
)
def test_a_wrong_wire_is_wrong_by_the_amount_asked_for(name: str, beyond_mm: float):
    bone = BONES[name].draw(np.random.default_rng(21)).bone()
    wires = wrong_wires(bone, beyond_mm, np.random.default_rng(22))
    assert set(wires) == KINDS[name]
    for kind, wire in wires.items():
        assert wire[0] == pytest.approx(bone.wires_mm[0, 0])
        if kind == FAR:
            found = bone.distance_mm(wire[1], "outline")
        elif kind == CORTEX:
            found = -bone.clearance_mm(wire)
        else:
            found = -bone.clearance_mm(wire, kind.removeprefix("into the "))
        assert found == pytest.approx(beyond_mm, abs=0.01)


def test_a_wrong_wire_needs_an_amount():
    bone = BONES["vertebra"].draw(np.random.default_rng(21)).bone()
    with pytest.raises(SetUpError, match="above zero"):
        wrong_wires(bone, 0.0, np.random.default_rng(22))
