"""The implant of a catalogue that fits a planned wire: its length, the angle of its plate, and its outline."""

from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import OutsideRegionError
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.metrics import metric
from sightline.planning.points.curve import Corridor
from sightline.planning.procedures.document import Catalogue, ProcedureDocument


@dataclass(frozen=True)
class Implant:
    """An implant of a catalogue: length, mm, and angle of the plate, °, each None where none fits or it is not known.

    `sentence`: what was chosen, and by what.
    """

    length_mm: float | None
    plate_angle_deg: float | None
    sentence: str


def fitting(catalogue: Catalogue, length_mm: float, anatomy: Anatomy | None, side: str | None) -> Implant | None:
    """Return the longest implant that is not longer than the wire in the bone, and the plate whose angle is nearest to
    the neck-shaft angle, if neck and shaft are drawn. None where the lengths do not follow from the wire.

    Raises UnusableInputError for an unknown side.
    """
    if not catalogue.along_wire:
        return None
    lengths, angles, of = catalogue.lengths_mm, catalogue.plate_angles_deg, catalogue.implants
    length = _fitting_mm(lengths, length_mm)
    if length is None:
        sentence = (
            f"None of the {of} fits: the wire runs {length_mm:.1f} mm, they have {lengths[0]:g} to {lengths[-1]:g} mm."
        )
    else:
        sentence = f"Of the {of} the one of {length:g} mm fits: the wire runs {length_mm:.1f} mm."
    if not angles or anatomy is None or side is None:
        return Implant(length, None, sentence)
    known = metric(anatomy, "neck-shaft angle", side)
    if known.value is None or known.sd is None:
        return Implant(length, None, sentence)
    angle, error = known.value, TWO_SIDED_95 * known.sd
    first, last = (min(angles, key=lambda plate_deg: abs(plate_deg - at)) for at in (angle - error, angle + error))
    near = [plate_deg for plate_deg in angles if first <= plate_deg <= last]
    plates = " or ".join(f"{plate_deg:g}°" for plate_deg in near)
    sentence += f" Neck and shaft enclose {angle:.1f}° ± {error:.1f}° (95 %): plate of {plates}."
    return Implant(length, near[0] if len(near) == 1 else None, sentence)


@dataclass(frozen=True, eq=False)
class Template:
    """The outline of an implant in one view, as far as the view is calibrated.

    It begins at the entry point. `length_mm`, `diameter_mm`: of the implant. `uv_px` (S, 2): its axis and `half_px`
    (S,): half its width in the image, IDCS. `thread`: from which of the S stations on the thread is; None without one,
    and where the view does not show it.
    """

    length_mm: float
    diameter_mm: float
    uv_px: np.ndarray
    half_px: np.ndarray
    thread: int | None


def template(seen: Corridor, wire_mm: float, document: ProcedureDocument) -> Template | None:
    """Return the outline of the implant that fits a wire of the length `wire_mm`, at its true size; None where none
    fits, its length does not follow from the wire, or the file states no single diameter.

    `seen`: the wire in the view. Raises OutsideRegionError where it does not show the implant.
    """
    catalogue, diameter = document.catalogue, _diameter_mm(document)
    if catalogue is None or diameter is None or not catalogue.along_wire:
        return None
    length = _fitting_mm(catalogue.lengths_mm, wire_mm)
    if length is None:
        return None
    thread = np.inf if catalogue.thread_mm is None else max(length - catalogue.thread_mm, 0.0)
    at = np.union1d(seen.along_mm, [mm for mm in (thread, length) if seen.along_mm[0] <= mm <= seen.along_mm[-1]])
    at = at[at <= length]
    if len(at) < 2:
        raise OutsideRegionError(
            "the implant lies outside the calibrated region of the image; move the frame so that its beads surround it"
        )
    # Cubic, because places along a wire towards the detector do not lie evenly in the image.
    u, v, half = _cubic(seen.along_mm, np.column_stack([seen.uv_px, seen.px_per_mm * diameter / 2]), at).T
    first = int(np.searchsorted(at, thread))
    return Template(length, diameter, np.column_stack([u, v]), half, first if first < len(at) - 1 else None)


def _cubic(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the values (A, n) at places (A,), from those (S, n) at increasing places `x` (S,), S > 1: for each place
    by the polynomial through the four stations nearest to it, or through all of fewer."""
    count = min(4, len(x))
    first = np.clip(np.searchsorted(x, at) - count // 2, 0, len(x) - count)
    stations = first[:, None] + np.arange(count)
    off = np.tile((at[:, None] - x[stations])[:, None], (1, count, 1))
    apart = x[stations][:, :, None] - x[stations][:, None]
    off[:, range(count), range(count)] = apart[:, range(count), range(count)] = 1.0
    return np.einsum("ak,akn->an", off.prod(axis=2) / apart.prod(axis=2), values[stations])


def _diameter_mm(document: ProcedureDocument) -> float | None:
    """Return the diameter that the corridor's checks hold for, or the catalogue's only one; None where it has more."""
    if document.corridor is not None:
        return document.corridor.implant_mm
    sizes = () if document.catalogue is None else document.catalogue.diameters_mm
    return sizes[0] if len(sizes) == 1 else None


def _fitting_mm(lengths: tuple[float, ...], wire_mm: float) -> float | None:
    """Return the longest of the lengths that is not longer than the wire; None where none fits."""
    step = lengths[-1] - lengths[max(len(lengths) - 2, 0)]  # a wire longer by more has no implant
    return None if wire_mm > lengths[-1] + step else max((mm for mm in lengths if mm <= wire_mm), default=None)
