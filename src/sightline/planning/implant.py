"""The implant of a catalogue that fits a planned wire: its length, and the angle of its plate."""

from dataclasses import dataclass

from sightline.geometry.covariance import TWO_SIDED_95
from sightline.planning.anatomy import Anatomy
from sightline.planning.metrics import metric
from sightline.planning.procedures.document import Catalogue


@dataclass(frozen=True)
class Implant:
    """An implant of a catalogue: length, mm, and angle of the plate, °, each None where none fits or it is not known.

    `sentence`: what was chosen, and by what.
    """

    length_mm: float | None
    plate_angle_deg: float | None
    sentence: str


def fitting(catalogue: Catalogue, length_mm: float, found: Anatomy | None, side: str | None) -> Implant | None:
    """Return the longest implant that is not longer than the wire in the bone, and the plate whose angle is nearest to
    the neck-shaft angle, if neck and shaft are drawn. None where the lengths do not follow from the wire.

    Raises UnusableInputError for an unknown side.
    """
    if not catalogue.along_wire:
        return None
    lengths, angles, of = catalogue.lengths_mm, catalogue.plate_angles_deg, catalogue.implants
    length = max((mm for mm in lengths if mm <= length_mm), default=None)
    if length is None or length_mm > lengths[-1] + _step_mm(lengths):
        length = None
        said = (
            f"None of the {of} fits: the wire runs {length_mm:.1f} mm, they have {lengths[0]:g} to {lengths[-1]:g} mm."
        )
    else:
        said = f"Of the {of} the one of {length:g} mm fits: the wire runs {length_mm:.1f} mm."
    if not angles or found is None or side is None:
        return Implant(length, None, said)
    known = metric(found, "neck-shaft angle", side)
    if known.value is None or known.sd is None:
        return Implant(length, None, said)
    angle, error = known.value, TWO_SIDED_95 * known.sd
    first, last = (min(angles, key=lambda one: abs(one - at)) for at in (angle - error, angle + error))
    near = [one for one in angles if first <= one <= last]
    plates = " or ".join(f"{one:g}°" for one in near)
    said += f" Neck and shaft enclose {angle:.1f}° ± {error:.1f}° (95 %): plate of {plates}."
    return Implant(length, near[0] if len(near) == 1 else None, said)


def _step_mm(lengths: tuple[float, ...]) -> float:
    """Return the last step between lengths; a wire longer by more than one has no implant."""
    return lengths[-1] - lengths[-2] if len(lengths) > 1 else 0.0
