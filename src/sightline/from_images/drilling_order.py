"""The order of drilling several wires in which the wires in the bone hide few beads of the next check images."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.frame import Frame
from sightline.frame.plate import Fiducial
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.verdict.relations import WireLines

DATUM_BEADS = 5.0  # a datum counts as so many beads: without it an image may not be labelled [ours]
_OUTSIDE_MM = 100.0  # length of a wire outside the entry, which hides beads too [ours]
_STEP_MM = 0.5


@dataclass(frozen=True, eq=False)
class DrillingOrder:
    """An order of drilling, by the wires' keys.

    `hidden`: for each wire, how many beads the wires that are in the bone before it hide in its check images; a datum
    counts as DATUM_BEADS.
    """

    keys: tuple[str, ...]
    hidden: tuple[float, ...]

    def sentence(self, names: Mapping[str, str]) -> str:
        """Return the order and what it hides, with the wires' names by key."""
        order = ", then the ".join(names[key] for key in self.keys)
        counts = ", ".join(f"{count:.0f}" for count in self.hidden)
        return (
            f"Drill the {order}. At the checks of these wires, those in the bone before hide {counts} beads in the "
            f"plan's views; a datum counts as {DATUM_BEADS:.0f}."
        )


def propose_order(
    wires: WireLines,
    procedure: ProcedureDocument,
    views: Sequence[CalibratedView],
    frame: Frame,
    placed: Collection[str] = (),
) -> DrillingOrder:
    """Return the order of drilling in which the wires in the bone hide the fewest beads, summed over all checks.

    `wires`: to be drilled or, by their keys in `placed`, in the bone already. `views`: the check images are expected
    from the same directions. The order keeps to the relations "order" of `procedure`; of orders that hide the same
    number the first in the file's own order is taken.
    """
    diameters = {wire.key: wire.diameter_mm for wire in procedure.wires}
    hides = {
        key: np.concatenate([_hidden(ends, diameters[key], view, frame) for view in views])
        for key, ends in zip(wires.keys, wires.ends_mm, strict=True)
    }
    weights = np.concatenate([[DATUM_BEADS if bead.datum else 1.0 for bead in _beads(frame, view)] for view in views])

    def hidden(order: Sequence[str]) -> tuple[float, ...]:
        before = np.any([np.zeros(len(weights), dtype=bool), *(hides[key] for key in placed)], axis=0)
        counts = []
        for key in order:
            counts.append(float(weights @ before))
            before = before | hides[key]
        return tuple(counts)

    chains = [one.wires for one in procedure.relations if one.relation == "order"]
    free = [key for key in procedure.drilling_order if key in wires.keys and key not in placed]
    orders = [order for order in permutations(free) if all(_kept(chain, order) for chain in chains)]
    best = min(orders or [tuple(free)], key=lambda order: sum(hidden(order)))
    return DrillingOrder(best, hidden(best))


def _kept(chain: Sequence[str], order: Sequence[str]) -> bool:
    places = [order.index(key) for key in chain if key in order]
    return all(a < b for a, b in pairwise(places))


def _beads(frame: Frame, view: CalibratedView) -> tuple[Fiducial, ...]:
    return frame.fiducials_of(view.name) if frame.solid is None else frame.solid.fiducials


def _hidden(ends_mm: np.ndarray, diameter_mm: float, view: CalibratedView, frame: Frame) -> np.ndarray:
    """Return which beads (N,) bool of a view a wire overlies, wholly or in part, where the view shows them."""
    beads, focal = _beads(frame, view), view.focal_point_mm
    xyz, radius = np.array([bead.xyz_mm for bead in beads]), np.array([bead.diameter_mm / 2 for bead in beads])
    entry, end = ends_mm
    length = float(np.linalg.norm(end - entry))
    on = entry + np.arange(-_OUTSIDE_MM, length, _STEP_MM)[:, None] * (end - entry) / length - focal
    rays = xyz - focal
    reach = np.linalg.norm(rays, axis=1)
    off = np.linalg.norm(np.cross(on[:, None], rays / reach[:, None]), axis=-1)
    shadow = radius * np.linalg.norm(on, axis=1)[:, None] / reach  # the bead's radius at the depth of the wire
    return (off < shadow + diameter_mm / 2).any(axis=0) & view.project_seen(xyz)[1]
