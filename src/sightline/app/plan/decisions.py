"""Decisions on a case: marks placed in the images, and confirmations. All can be undone.

Nothing here is computed; all results follow from these decisions and the images.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, AwareDatetime, PlainSerializer, StrictBool, TypeAdapter

from sightline.app.plan.marks import END, ENTRY, MarkSpec, border_mark, marks_of
from sightline.case.canonical import plain
from sightline.case.views import NAMES
from sightline.errors import CaseError, UnusableInputError
from sightline.planning import Circle, Line, Nail
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.procedure import ProcedureKey, current_key

Pixels = Mapping[str, Any]  # a circle or line as JSON types, so that equal ones compare equal


@dataclass(frozen=True)
class FittedHead:
    """Circles in PA and lateral image; `kept`: why an image's circle is still the drawn one, by view."""

    circles: tuple[Pixels, Pixels]
    kept: Mapping[str, str]

    def __post_init__(self) -> None:
        for circle in self.head:
            count = len(circle.uv_px)
            if circle.uv_px.shape != (count, 2) or circle.covariance_px2.shape != (2 * count, 2 * count):
                raise ValueError(circle.uv_px.shape)

    @property
    def head(self) -> tuple[Circle, Circle]:
        """The circles."""
        first, second = (Circle(**_arrays(circle)) for circle in self.circles)
        return first, second


@dataclass(frozen=True)
class FittedAxis:
    """Lines with their borders in PA and lateral image; `kept`: why an image's line is still the drawn one, by view."""

    lines: tuple[Pixels, Pixels]
    kept: Mapping[str, str]

    def __post_init__(self) -> None:
        for line in self.axis:
            borders = line.borders_px
            if borders is None or borders.shape != (2, 2, 2) or line.spread_px2.shape != (4, 4):
                raise ValueError(borders)

    @property
    def axis(self) -> tuple[Line, Line]:
        """The lines."""
        first, second = (Line(**_arrays(line)) for line in self.lines)
        return first, second


def as_fitted(pair: Sequence[Circle | Line], kept: Mapping[str, str]) -> FittedHead | FittedAxis:
    """Return the result of `fit_head`, `fit_shaft` or `fit_neck`."""
    first, second = map(plain, pair)
    return (FittedHead if isinstance(pair[0], Circle) else FittedAxis)((first, second), dict(kept))


def _arrays(document: Pixels) -> dict[str, Any]:
    return {key: np.array(value) if isinstance(value, list) else value for key, value in document.items()}


Side = Literal["right", "left"]
Pixel = tuple[float, float]
HEAD, SHAFT, NECK = "head", "shaft", "neck"  # keys of the aids that can be fitted to edges
MAX_MARKS = 64  # more than any procedure needs; a page that sends more is defective [ours]


@dataclass(frozen=True)
class Mark:
    """A point that a person placed: IDCS px by image name, "pa", "lateral" or a check image.

    `free`: its lateral pixel was placed freely. Otherwise it was snapped to the image-matching curve of its PA pixel,
    which makes it a one-dimensional measurement.
    """

    places: Mapping[str, Pixel] = field(default_factory=dict)
    free: bool = True

    def at(self, image: str) -> Pixel | None:
        """Return its pixel in an image; None if it is not placed there."""
        return self.places.get(image)

    def placed(self, image: str, uv_px: Pixel | None, *, free: bool | None = None) -> "Mark":
        """Return the mark moved in one image, or with None removed from it. Removing the PA pixel of a snapped mark
        also removes its lateral one."""
        gone = {image, NAMES[1]} if uv_px is None and image == NAMES[0] and not self.free else {image}
        places = {name: uv for name, uv in self.places.items() if name not in gone}
        if uv_px is not None:
            places[image] = uv_px
        return Mark(places, self.free if free is None else free)

    def complete(self, images: Iterable[str] = NAMES) -> bool:
        """Return True if it is placed in all of these images."""
        return all(image in self.places for image in images)


_UNPLACED = Mark()


@dataclass(frozen=True)
class Display:
    """How an image is shown: mirrored left to right, then rotated clockwise, degrees. Coordinates do not change.

    `rotation` None: with the patient's head up, where that is known. `window`: centre and width in grey levels; None:
    the default for the image.
    """

    rotation: Annotated[int, AfterValidator(lambda degrees: degrees % 360)] | None = None
    mirrored: bool = False
    inverted: bool = False
    window: tuple[float, float] | None = None


@dataclass(frozen=True)
class Decisions:
    """All decisions at one moment.

    `images`: number of the journal entry that acquired each image, by image name. `kind`: the procedure and, of
    several wires, the current one, whose entry and end are among `marks`; `wires`: those of the others, by their kinds.
    `serial`: of the frame, as read by a person. `snapping`: lateral points of the wire are snapped to their curves when
    placed. `taken`: time of acquisition stated by a person, by entry number, for images whose file does not state it.
    `mirrored`: whether a person saw, by writing in it, that the file shows the image mirrored, by entry number; needed
    if no image shows the frame unmirrored. `nail`: whose holes are found in the images; None: points are placed.
    `fitted_head`: the head's circles as fitted to edges; None: as drawn. `borders`: axes are drawn by both borders of
    the bone; `fitted_shaft`, `fitted_neck`: those of shaft and neck as fitted to edges, the neck's from the head's
    centre of that time. `bone`: number of the entry that holds the pose of the bone's CT or mesh, once accepted; it
    counts while the images are those that it was found in.
    """

    images: Mapping[str, int] = field(default_factory=dict)
    kind: Annotated[str, AfterValidator(current_key)] = "hip-screw"
    side: Side | None = None
    serial: str | None = None
    marks: Mapping[str, Mark] = field(default_factory=dict)
    display: Mapping[str, Display] = field(default_factory=dict)
    snapping: bool = True
    taken: Mapping[int, Annotated[AwareDatetime, PlainSerializer(datetime.isoformat)]] = field(default_factory=dict)
    mirrored: Mapping[int, StrictBool] = field(default_factory=dict)
    wires: Mapping[str, Mapping[str, Mark]] = field(default_factory=dict)
    nail: Nail | None = None
    fitted_head: FittedHead | None = None
    borders: bool = False
    fitted_shaft: FittedAxis | None = None
    fitted_neck: FittedAxis | None = None
    bone: int | None = None

    @property
    def of_nail(self) -> bool:
        """True if the wires run through holes of a chosen nail. Raises UnusableInputError."""
        return self.nail is not None and kind_of(self.kind).document.through_holes

    @property
    def specs(self) -> tuple[MarkSpec, ...]:
        """The marks that the page asks for, in order. Raises UnusableInputError."""
        return marks_of(self.kind, of_nail=self.of_nail, borders=self.borders)

    def mark(self, name: str) -> Mark:
        """Return the mark of a name; an empty one if it is not placed."""
        return self.marks.get(name, _UNPLACED)

    def ends(self, kind: str) -> Mapping[str, Mark]:
        """Return the marks of a wire's entry and end, those that are placed, by its kind."""
        if kind != self.kind:
            return self.wires.get(kind, {})
        return {name: self.marks[name] for name in (ENTRY, END) if name in self.marks}

    def with_ends(self, kind: str, ends: Mapping[str, Mark]) -> "Decisions":
        """Return the decisions with other marks of a wire's entry and end."""
        if kind != self.kind:
            return replace(self, wires={**self.wires, kind: dict(ends)})
        rest = {name: mark for name, mark in self.marks.items() if name not in (ENTRY, END)}
        return replace(self, marks={**rest, **ends})

    def with_kind(self, kind: str) -> "Decisions":
        """Return the decisions with another wire or procedure current; the first time that a procedure is chosen, its
        wire has entry and end of the current one."""
        if kind == self.kind:
            return self
        own, new = self.ends(self.kind), ProcedureKey.of(kind).file != ProcedureKey.of(self.kind).file
        ends = self.wires.get(kind, own if new else {})
        left = {key: marks for key, marks in self.wires.items() if key != kind}
        return replace(self, kind=kind, wires=left).with_ends(self.kind, own).with_ends(kind, ends)

    def complete(self, names: Iterable[str]) -> bool:
        """Return True if all of these marks are placed in both planning images."""
        return all(self.mark(name).complete() for name in names)

    def with_mark(self, name: str, mark: Mark | None) -> "Decisions":
        """Return the decisions with one mark set, or removed if it is None or empty; a click on the head's rim or on
        borders ends their fit, one on the rim also that of the neck, which begins at the head's centre. Raises
        CaseError if there are too many."""
        marks = {key: value for key, value in self.marks.items() if key != name}
        if mark is not None and mark.places:
            marks[name] = mark
        if len(marks) > MAX_MARKS:
            raise CaseError(f"a case holds at most {MAX_MARKS} marks; remove some that are not needed")
        drawn = name.rpartition("-")[0]
        head = None if drawn == HEAD else self.fitted_head
        shaft = None if drawn == border_mark(SHAFT) else self.fitted_shaft
        neck = None if drawn in (HEAD, border_mark(NECK)) else self.fitted_neck
        return replace(self, marks=marks, fitted_head=head, fitted_shaft=shaft, fitted_neck=neck)

    def with_image(self, name: str, acquired: int, *, same_pixels: bool) -> "Decisions":
        """Return the decisions with another image under a name. Unless the pixels are the same, the marks in it are
        removed, and for a planning image also the patient's side and what was fitted to its edges."""
        images = {**self.images, name: acquired}
        if same_pixels:
            return replace(self, images=images)
        wires = {kind: _without(name, ends) for kind, ends in self.wires.items()}
        left = replace(self, images=images, marks=_without(name, self.marks), wires=wires)
        return (
            replace(left, side=None, fitted_head=None, fitted_shaft=None, fitted_neck=None) if name in NAMES else left
        )

    def document(self) -> dict[str, Any]:
        """Return the decisions as JSON types."""
        return _JSON.dump_python(self, mode="json")

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Decisions":
        """Return the decisions from JSON types. Raises CaseError."""
        try:
            marks, display = document["marks"].values(), document["display"].values()
            # Later fields may be missing in older cases: snapping was always on, axes were always drawn themselves.
            parts = [(document, _FIRST), *((mark, _MARK) for mark in marks), *((shown, _DISPLAY) for shown in display)]
            if not all(wanted <= part.keys() for part, wanted in parts):
                raise ValueError(document)
            return _JSON.validate_python(document)
        except (KeyError, TypeError, ValueError, AttributeError, UnusableInputError) as error:
            raise CaseError(
                "a change in the case's journal cannot be read; run `sightline case check` on it"
            ) from error


_JSON = TypeAdapter(Decisions)
_FIRST = {"images", "kind", "side", "serial", "marks", "display"}  # in every case
_MARK, _DISPLAY = vars(Mark()).keys(), vars(Display()).keys()


class History:
    """History of decisions with undo and redo. `revision` grows with every change."""

    def __init__(self, past: Iterable[tuple[str, Decisions | None]] = ()) -> None:
        """`past`: recorded changes in order, ("edit", decisions), ("undo", None) or ("redo", None)."""
        self._all = [Decisions()]
        self._at = 0
        self.revision = 0
        for what, decisions in past:
            if what == "edit" and decisions is not None:
                self.edit(decisions)
            elif what == "undo":
                self.undo()
            else:
                self.redo()

    @property
    def now(self) -> Decisions:
        """The current decisions."""
        return self._all[self._at]

    @property
    def can_undo(self) -> bool:
        """True if there is something to undo."""
        return self._at > 0

    @property
    def can_redo(self) -> bool:
        """True if something was undone and nothing was changed since."""
        return self._at + 1 < len(self._all)

    def edit(self, decisions: Decisions) -> None:
        """Add a change; undone changes can no longer be redone."""
        self._all = [*self._all[: self._at + 1], decisions]
        self._at = len(self._all) - 1
        self.revision += 1

    def undo(self) -> None:
        """Go one change back, if there is one."""
        if self.can_undo:
            self._at -= 1
            self.revision += 1

    def redo(self) -> None:
        """Go one change forward again, if there is one."""
        if self.can_redo:
            self._at += 1
            self.revision += 1


def _without(image: str, marks: Mapping[str, Mark]) -> Mapping[str, Mark]:
    """Return the marks without their pixels in an image."""
    left = {name: mark.placed(image, None) for name, mark in marks.items()}
    return {name: mark for name, mark in left.items() if mark.places}
