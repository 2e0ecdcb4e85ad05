"""What people decide on a case: marks placed in the two images and what is confirmed of them. All of it can be undone.

Nothing here is computed; everything that is computed follows from these decisions and the two images.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from types import MappingProxyType
from typing import Any, Literal

from sightline.case.views import NAMES
from sightline.errors import CaseError

Side = Literal["right", "left"]
Pixel = tuple[float, float]
MOST_MARKS = 64  # no procedure needs as many; a page that sends more is broken [ours]
MOST_UNDONE = 500  # changes that are remembered; the journal has them all [ours]


@dataclass(frozen=True)
class Mark:
    """A point that a person placed: IDCS px by the name of the image, "pa", "lateral" or one of the check shot.

    `free`: placed in the lateral image wherever the person saw it. Otherwise it was taken to the image-matching curve
    of its PA pixel, and says one number, not two.
    """

    places: Mapping[str, Pixel] = field(default_factory=lambda: MappingProxyType({}))
    free: bool = True

    def at(self, image: str) -> Pixel | None:
        """Its pixel in an image; None where it is not placed."""
        return self.places.get(image)

    def placed(self, image: str, uv_px: Pixel | None, *, free: bool | None = None) -> "Mark":
        """Moved in one image, or with None taken away from it: a place on the curve of a PA pixel goes with that."""
        gone = {image, NAMES[1]} if uv_px is None and image == NAMES[0] and not self.free else {image}
        places = {name: uv for name, uv in self.places.items() if name not in gone}
        if uv_px is not None:
            places[image] = uv_px
        return Mark(MappingProxyType(places), self.free if free is None else free)

    def complete(self, images: Iterable[str] = NAMES) -> bool:
        """True if it is placed in all of these images."""
        return all(image in self.places for image in images)

    def document(self) -> dict[str, Any]:
        """As JSON types."""
        return {"places": {image: list(uv) for image, uv in self.places.items()}, "free": self.free}


@dataclass(frozen=True)
class Display:
    """How an image is shown: mirrored left to right, then turned clockwise; coordinates never follow."""

    rotation: int = 0
    mirrored: bool = False
    inverted: bool = False
    window: tuple[float, float] | None = None  # centre and width; None: what the image holds


@dataclass(frozen=True)
class Decisions:
    """All that people decided, at one moment. `images`: by name, the journal's entry that acquired it. `serial`: of the
    frame, as a person read it. `snapping`: lateral points of the wire are taken to their curves when they are placed.
    `taken`: by the image's entry, when a person says that it was taken; asked for where the file does not say it.
    `mirrored`: by the image's entry, whether a person saw that the file shows it mirrored, by writing in it; asked for
    where no image shows the frame unmirrored.
    """

    images: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    kind: str = "hip-screw"
    side: Side | None = None
    serial: str | None = None
    marks: Mapping[str, Mark] = field(default_factory=lambda: MappingProxyType({}))
    display: Mapping[str, Display] = field(default_factory=lambda: MappingProxyType({}))
    snapping: bool = True
    taken: Mapping[int, datetime] = field(default_factory=lambda: MappingProxyType({}))
    mirrored: Mapping[int, bool] = field(default_factory=lambda: MappingProxyType({}))

    def mark(self, name: str) -> Mark:
        """The mark of a name; an empty one where it is not placed."""
        return self.marks.get(name, Mark())

    def complete(self, names: Iterable[str]) -> bool:
        """True if all of these marks are placed in both planning images."""
        return all(self.mark(name).complete() for name in names)

    def with_mark(self, name: str, mark: Mark | None) -> "Decisions":
        """One mark set; with None, or without a place, removed. Raises CaseError where there are too many."""
        marks = {key: value for key, value in self.marks.items() if key != name}
        if mark is not None and mark.places:
            marks[name] = mark
        if len(marks) > MOST_MARKS:
            raise CaseError(f"a case holds at most {MOST_MARKS} marks; remove some that are not needed")
        return replace(self, marks=MappingProxyType(marks))

    def with_image(self, name: str, acquired: int, *, same_pixels: bool) -> "Decisions":
        """Another image under a name; what was decided on the one before, marks placed in it and in a planning image
        the patient's side, stays only where the pixels are the same."""
        images = MappingProxyType({**self.images, name: acquired})
        if same_pixels:
            return replace(self, images=images)
        left = {key: mark.placed(name, None) for key, mark in self.marks.items()}
        marks = MappingProxyType({key: mark for key, mark in left.items() if mark.places})
        return replace(self, images=images, marks=marks, side=None if name in NAMES else self.side)

    def with_display(self, view: str, display: Display) -> "Decisions":
        """One view shown otherwise."""
        return replace(self, display=MappingProxyType({**self.display, view: display}))

    def with_taken(self, acquired: int, at: datetime) -> "Decisions":
        """When the image of an entry was taken."""
        return replace(self, taken=MappingProxyType({**self.taken, acquired: at}))

    def with_mirrored(self, acquired: int, mirrored: bool) -> "Decisions":
        """Whether the file shows the image of an entry mirrored."""
        return replace(self, mirrored=MappingProxyType({**self.mirrored, acquired: mirrored}))

    def document(self) -> dict[str, Any]:
        """As JSON types."""
        return {
            "images": dict(self.images),
            "kind": self.kind,
            "side": self.side,
            "serial": self.serial,
            "marks": {name: mark.document() for name, mark in self.marks.items()},
            "display": {name: vars(display) for name, display in self.display.items()},
            "snapping": self.snapping,
            "taken": {str(acquired): at.isoformat() for acquired, at in self.taken.items()},
            "mirrored": {str(acquired): mirrored for acquired, mirrored in self.mirrored.items()},
        }

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Decisions":
        """From JSON types. Raises CaseError."""
        try:
            marks = {str(name): _mark(mark) for name, mark in document["marks"].items()}
            display = {str(name): _display(shown) for name, shown in document["display"].items()}
            side = document["side"]
            if side not in ("right", "left", None):
                raise ValueError(side)
            return Decisions(
                MappingProxyType({str(name): int(number) for name, number in document["images"].items()}),
                str(document["kind"]),
                side,
                document["serial"],
                MappingProxyType(marks),
                MappingProxyType(display),
                bool(document.get("snapping", True)),  # before it was decided, every page began with it
                MappingProxyType({int(number): _instant(at) for number, at in document.get("taken", {}).items()}),
                MappingProxyType({int(number): _truth(said) for number, said in document.get("mirrored", {}).items()}),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CaseError(
                "a change in the case's journal cannot be read; run `sightline case check` on it"
            ) from error


class History:
    """Decisions over time: `now`, what can be undone, and a revision that grows with every change of any kind."""

    def __init__(self, past: Iterable[tuple[str, Decisions | None]] = ()) -> None:
        """From what was recorded, in its order: ("edit", decisions), ("undo", None), ("redo", None)."""
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
        """The decisions that hold."""
        return self._all[self._at]

    @property
    def can_undo(self) -> bool:
        """True if there is something to undo."""
        return self._at > 0

    @property
    def can_redo(self) -> bool:
        """True if something was undone and nothing changed since."""
        return self._at + 1 < len(self._all)

    def edit(self, decisions: Decisions) -> None:
        """Change; what was undone before is gone."""
        self._all = [*self._all[: self._at + 1], decisions][-MOST_UNDONE:]
        self._at = len(self._all) - 1
        self.revision += 1

    def undo(self) -> None:
        """One change back; nothing where there is none."""
        if self.can_undo:
            self._at -= 1
            self.revision += 1

    def redo(self) -> None:
        """One change forth again; nothing where there is none."""
        if self.can_redo:
            self._at += 1
            self.revision += 1


def _mark(document: Mapping[str, Any]) -> Mark:
    places = {str(image): (float(u), float(v)) for image, (u, v) in document["places"].items()}
    return Mark(MappingProxyType(places), bool(document["free"]))


def _instant(text: str) -> datetime:
    at = datetime.fromisoformat(text)
    if at.tzinfo is None:
        raise ValueError(text)
    return at


def _truth(said: Any) -> bool:
    if not isinstance(said, bool):
        raise TypeError(said)
    return said


def _display(shown: Mapping[str, Any]) -> Display:
    window = shown["window"]
    return Display(
        int(shown["rotation"]) % 360,
        bool(shown["mirrored"]),
        bool(shown["inverted"]),
        None if window is None else (float(window[0]), float(window[1])),
    )
