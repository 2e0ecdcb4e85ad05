"""What `simulate --with` puts into the beam: placed by the wire and the body, and only where there is a wire."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.twin.objects.things import Scene, SoftTissue
from sightline.twin.scenes.specimens import ACCESSORIES, Specimen, with_accessories

WIRE_MM = np.array([[31.3, 28.9, -9.7], [-30.1, -27.7, 8.3]])
NEEDS_A_WIRE = ("guide-wire", "lag-screw", "angled-plate", "drill-guide")


@pytest.fixture
def hip(setup) -> Specimen:
    return Specimen(setup, Scene(tissue=SoftTissue()), {"frame": "gamma"}, True, WIRE_MM)


def parts(specimen: Specimen) -> int:
    return len(specimen.scene.solids) + len(specimen.scene.boxes)


@pytest.mark.parametrize("name", ACCESSORIES)
def test_each_accessory_adds_its_parts_and_stands_in_the_truth(hip: Specimen, name: str) -> None:
    more = with_accessories(hip, [name], np.random.default_rng(1))
    assert parts(more) > 0 == parts(hip)
    assert more.truth == {"frame": "gamma", "with": [name]}


@pytest.mark.parametrize("name", NEEDS_A_WIRE)
def test_what_belongs_to_a_wire_needs_one(hip: Specimen, name: str) -> None:
    with pytest.raises(UnusableInputError, match="hip, plastic or porcine"):
        with_accessories(replace(hip, wire_mm=None), [name], np.random.default_rng(1))


def test_a_plate_runs_down_the_shaft_of_either_hip(hip: Specimen) -> None:
    right = with_accessories(hip, ["angled-plate"], np.random.default_rng(1)).scene.boxes[0]
    mirrored = replace(hip, setup=replace(hip.setup, side="left"), wire_mm=WIRE_MM * [1.0, -1.0, 1.0])
    left = with_accessories(mirrored, ["angled-plate"], np.random.default_rng(1)).scene.boxes[0]
    assert right.centre_mm[1] > WIRE_MM[0, 1]
    np.testing.assert_allclose(left.centre_mm, right.centre_mm * [1.0, -1.0, 1.0])
