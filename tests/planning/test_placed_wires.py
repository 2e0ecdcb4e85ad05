"""Placed wires in space: place, covariance by sampling, and wires that are exchanged between the views."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sightline.errors import OutsideRegionError, ReconstructionRefusedError
from sightline.planning import Axis
from sightline.planning.placed_wires import placed_wires

from .bone import END_MM, ENTRY_MM, views
from .standin import StandInView

WIRE = np.array([ENTRY_MM, END_MM])
UP = np.array([6.0, -7.0, 2.0])  # to a wire whose tip lies on other epipolar planes
FRONT = np.array([7.0, -0.465, 5.0])  # to one whose tip both images show at the same height
ACROSS_PX, TIP_PX = 0.1, 0.5


@dataclass(frozen=True, eq=False)
class Seen:
    """See `WireSeen`."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_variance_px2: float


def seen(view: StandInView, wire: np.ndarray, rng: np.random.Generator | None = None) -> Seen:
    """A wire as a view shows it, with noise where there is a generator."""
    uv = view.project(wire[0] + np.linspace(-0.05, 0.93, 20)[:, None] * (wire[1] - wire[0]))
    tip = view.project(wire[1:])[0]
    way = (tip - uv[-1]) / np.linalg.norm(tip - uv[-1])
    if rng is not None:
        uv = uv + ACROSS_PX * rng.standard_normal((20, 1)) * [-way[1], way[0]]
        tip = tip + TIP_PX * rng.standard_normal() * way
    return Seen(uv, np.full(20, ACROSS_PX**2), tip, TIP_PX**2)


def found(*wires: np.ndarray, shown: tuple[StandInView, ...] | None = None, rng=None) -> list[Axis]:
    """The wires as found, with entries clicked 2 mm beside them."""
    true = shown or tuple(views())
    both = {f"wire {k}": [seen(view, wire, rng) for view in true] for k, wire in enumerate(wires)}
    entries = {f"wire {k}": wire[0] + [1.0, -1.0, 1.5] for k, wire in enumerate(wires)}
    return list(placed_wires(views(), both, entries).values())


def off_mm(axis: Axis, wire: np.ndarray) -> tuple[float, float]:
    """The distances of the first end from the wire's axis, and of the tip from its tip."""
    return float(Axis(wire, None).distance_mm(axis.ends_mm[0])), float(np.linalg.norm(axis.ends_mm[1] - wire[1]))


def test_wires_lie_where_they_are():
    for axis, wire in zip(found(WIRE, WIRE + UP), (WIRE, WIRE + UP), strict=True):
        assert max(off_mm(axis, wire)) < 0.02
        assert np.linalg.norm(axis.ends_mm[0] - wire[0]) < 3.0  # near the click


@pytest.mark.slow
def test_the_stated_covariance_is_that_of_the_errors():
    """Errors of the views and of the images, drawn; the place along the wire of the chosen entry does not count."""
    rng, squares = np.random.default_rng(3), []
    along = (WIRE[1] - WIRE[0]) / np.linalg.norm(WIRE[1] - WIRE[0])
    beside = np.linalg.svd(along[None])[2][1:]
    for _ in range(100):
        pa, lateral = (view.draw_errors(rng) for view in views())
        lateral["frame"] = pa["frame"]
        true = tuple(view.erring(errors) for view, errors in zip(views(), (pa, lateral), strict=True))
        try:
            (axis,) = found(WIRE, shown=true, rng=rng)
        except ReconstructionRefusedError:  # once in a thousand
            continue
        error = np.concatenate([beside @ (axis.ends_mm[0] - WIRE[0]), axis.ends_mm[1] - WIRE[1]])
        to = np.zeros((5, 6))
        to[:2, :3], to[2:, 3:] = beside, np.eye(3)
        squares.append(error @ np.linalg.solve(to @ axis.covariance_mm2 @ to.T, error))
    assert len(squares) > 97
    assert 0.8 < np.mean(squares) / 5 < 1.25  # 500 numbers: 1 ± 0.06, and the line is not straight in the errors


def test_two_wires_taken_for_one_are_refused():
    pa, lateral = views()
    wires = {"inferior": [seen(pa, WIRE), seen(lateral, WIRE + UP)]}
    with pytest.raises(ReconstructionRefusedError, match="two different wires"):
        placed_wires(views(), wires, {"inferior": ENTRY_MM})


def test_wires_that_the_tips_do_not_tell_apart_are_refused():
    """Their exchange between the images would be as right."""
    with pytest.raises(ReconstructionRefusedError, match="cannot be told which line is which"):
        found(WIRE, WIRE + FRONT)


def test_a_tip_that_is_wrong_in_one_image_is_refused():
    pa, lateral = (seen(view, WIRE) for view in views())
    way = (pa.tip_uv_px - pa.uv_px[-1]) / np.linalg.norm(pa.tip_uv_px - pa.uv_px[-1])
    with pytest.raises(ReconstructionRefusedError, match="tips"):
        placed_wires(views(), {"a": [replace(pa, tip_uv_px=pa.tip_uv_px + 15.0 * way), lateral]}, {"a": ENTRY_MM})
    with pytest.raises(OutsideRegionError):
        placed_wires(views(), {"a": [pa, lateral]}, {"a": ENTRY_MM + 500.0})
