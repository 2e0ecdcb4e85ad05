"""The marks that a person may place for a procedure, in the order in which the page asks for them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from sightline.case.views import CHECK_NAMES, NAMES, OBLIQUE, SHOT_NAMES
from sightline.planning.check.adjustment import CURVE
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.document import AidAsked

Group = Literal["wire", "nail", "landmark", "aid", "guide", "robot", "bone"]
ENTRY, END = "entry", "end"
_EDGES = {"a": "One edge of the nail", "b": "Other edge of the nail"}
_STROKE = {  # the two clicks of a stroke
    1: "Click on it, above all holes to be drilled.",
    2: "Click on it, below all holes to be drilled.",
}
# How an axis is drawn by both borders of the bone, in place of the procedure's own sentence.
_BORDERS = "Two clicks on one border of the bone, two on the other, beside each other where both are straight."
_BORDER_CLICKS = 4
_HOLE = "Click the middle of its bright lens, where light passes both walls."


@dataclass(frozen=True)
class MarkSpec:
    """Specification of one mark. `of`: the wire point, landmark or aid that it belongs to; `images`: those it is placed
    in."""

    name: str
    label: str
    sentence: str
    group: Group
    of: str
    images: tuple[str, ...] = NAMES

    def shown_in(self, image: str) -> bool:
        """Return True if it may be placed in an image.

        In check images these are the landmarks, in shots while drilling also points on the robot's wire, in a third
        image the landmarks and the points of the wire.
        """
        if image in (*CHECK_NAMES, *SHOT_NAMES):
            return self.group == "landmark" or image in self.images
        return image in self.images or (image == OBLIQUE and self.group != "aid")


def _on_guide(k: int) -> MarkSpec:
    what = "its tip, the end in the field" if k > GUIDE_POINTS else f"point {k}, from the far end towards its tip"
    return MarkSpec(
        f"guide-{k}",
        f"Wire {'tip' if k > GUIDE_POINTS else k}",
        f"The middle of the robot's wire: {what}.",
        "guide",
        "guide",
        SHOT_NAMES,
    )


# Both edges of a nail, each a stroke of two clicks.
NAIL_EDGES = tuple(
    MarkSpec(f"nail-edge-{edge}-{click}", f"{label} {click}", _STROKE[click], "nail", f"nail-edge-{edge}")
    for edge, label in _EDGES.items()
    for click in _STROKE
)

# On the robot's wire in its guide, the tip last: it lies in part before a saturated background, so a person picks it.
GUIDE_POINTS = CURVE + 1  # one more than its curve needs [calc]
GUIDE = tuple(map(_on_guide, range(1, GUIDE_POINTS + 2)))


def marks_of(kind: str, *, of_nail: bool = False, borders: bool = False) -> tuple[MarkSpec, ...]:
    """Return all marks of a procedure, by its key, in the order in which the page asks for them.

    `of_nail`: its wires run through holes that are found in the images; then strokes and clicks on the nail take the
    place of the wires' points and of the aids. `borders`: axes are drawn by both borders of the bone. Raises
    UnusableInputError."""
    return _marks_of(kind_of(kind), of_nail, borders)


def by_borders(aid: AidAsked, borders: bool) -> bool:
    """Return True if an aid is an axis that is drawn by both borders of the bone."""
    return borders and aid.type == "line"


def aid_marks(aid: AidAsked, borders: bool) -> tuple[str, ...]:
    """Return the names of an aid's marks. An axis has others where it is drawn by both `borders`."""
    if by_borders(aid, borders):
        return tuple(f"{border_mark(aid.key)}-{k + 1}" for k in range(_BORDER_CLICKS))
    return tuple(f"{aid.key}-{k + 1}" for k in range(aid.clicks))


def border_mark(aid: str) -> str:
    """Return the names, without their numbers, of the marks on the borders of an axis, by its key."""
    return f"{aid}-border"


@lru_cache
def _marks_of(known: Procedure, of_nail: bool, borders: bool) -> tuple[MarkSpec, ...]:
    landmarks = [MarkSpec(f"landmark-{p.key}", _titled(p.name), p.sentence, "landmark", p.key) for p in known.landmarks]
    if of_nail:
        holes = [
            MarkSpec(hole_mark(wire.key), _titled(wire.name), _HOLE, "nail", hole_mark(wire.key))
            for wire in known.document.wires
        ]
        return (*NAIL_EDGES, *holes, *landmarks)
    wire = [
        MarkSpec(name, _titled(point.name), point.sentence, "wire", name)
        for name, point in zip((ENTRY, END), known.points, strict=True)
    ]
    aids = []
    for aid in known.aids:
        images = images_of(known, aid)
        names = aid_marks(aid, borders) if images else ()
        sentence = _BORDERS if by_borders(aid, borders) else aid.sentence
        for k, name in enumerate(names):
            label = f"{_titled(aid.name)} {k + 1}" if len(names) > 1 else _titled(aid.name)
            aids.append(MarkSpec(name, label, sentence, "aid", aid.key, images))
    return (*wire, *landmarks, *aids)


def hole_mark(wire: str) -> str:
    """Return the name of the mark in a wire's hole."""
    return f"hole-{wire}"


def images_of(known: Procedure, aid: AidAsked) -> tuple[str, ...]:
    """Return the images that an aid is drawn in: those in the places of its views among the procedure's."""
    return tuple(image for image, view in zip(NAMES, known.document.views, strict=False) if view.name in aid.views)


def label_of(same: Sequence[MarkSpec]) -> str:
    """Return the label of one mark, or of several clicks together: without their numbers."""
    return same[0].label if len(same) == 1 else same[0].label.rsplit(" ", 1)[0]


def _titled(name: str) -> str:
    return name[:1].upper() + name[1:]


def names_of(kind: str, group: Group) -> tuple[str, ...]:
    """Return the names of one group's marks."""
    return tuple(spec.name for spec in marks_of(kind) if spec.group == group)
