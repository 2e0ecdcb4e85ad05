"""How a drill through a nail is judged by its check shot: at both walls, and by where its tip ends."""

import numpy as np
import pytest

from sightline.common.checks import Check, Limits
from sightline.planning.check.result import checks

from .shots import straight_shot

WALLS_MM, BEYOND_MM = 11.0, 15.0
LIMITS = Limits(position_mm=0.5, direction_rad=np.deg2rad(5.2), beyond_mm=BEYOND_MM)


def _judged(*deviation_mm: float, sd_mm: float = 0.05, walls_mm: float | None = WALLS_MM) -> dict[str, Check]:
    wire = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, WALLS_MM + BEYOND_MM]])
    shot = straight_shot(wire, np.eye(3)[:2], deviation_mm, sd_mm)
    return {check.name: check for check in checks(shot, LIMITS, (), walls_mm)}


def test_a_drill_is_judged_at_both_walls_and_not_at_its_tip():
    # 0.1 mm off at the near hole and 0.9 mm at a tip that stops 4 mm short: 11 of 22 mm on, 0.5 mm off.
    made = _judged(0.1, 0.0, 0.89, 0.0, -4.0)
    assert made["wire at far hole"].figure == pytest.approx(0.1 + 0.79 * 11 / 22)
    assert made["wire tip"].figure == pytest.approx(11.0)
    assert all(check.passed for check in made.values())
    assert not _judged(0.1, 0.0, 0.92, 0.0, -4.0)["wire at far hole"].passed
    assert not _judged(0.51, 0.0, 0.0, 0.0, 0.0)["wire entry"].passed
    assert not _judged(0.1, 0.0, 0.89, 0.0, -4.0, walls_mm=None)["wire tip"].passed  # of a wire


@pytest.mark.parametrize(("along_mm", "passed"), [(-15.5, False), (-14.5, True), (0.4, True), (0.6, False)])
def test_the_tip_has_passed_the_far_hole_and_not_gone_farther_than_the_file_allows(along_mm: float, passed: bool):
    check = _judged(0.0, 0.0, 0.0, 0.0, along_mm)["wire tip"]
    assert check.passed is passed
    assert ("must have passed it" in check.sentence) is not passed


def test_the_error_is_that_at_the_far_hole():
    """Halfway between entry and tip, where both have equal errors, the error is smaller than theirs."""
    assert _judged(0.0, 0.0, 0.0, 0.0, -4.0, sd_mm=0.15)["check shot error"].passed
    known = {name: check.sentence for name, check in _judged(0.0, 0.0, 0.0, 0.0, -4.0, sd_mm=0.15).items()}
    near, far = (
        float(known[name].split("known to ")[1].split(" mm")[0]) for name in ("wire entry", "wire at far hole")
    )
    assert far == pytest.approx(near / np.sqrt(2), abs=0.006)
    assert not _judged(0.0, 0.0, 0.0, 0.0, -4.0, sd_mm=0.25)["check shot error"].passed
