"""The marks that a person may place for a kind of trajectory, in the order in which the page asks for them."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

from sightline.case.views import NAMES
from sightline.planning.procedures import kind as kind_of

Group = Literal["wire", "landmark", "aid"]
CHECK_NAMES = (f"check-{NAMES[0]}", f"check-{NAMES[1]}")
ENTRY, END = "entry", "end"
# Clicks that define an aid: their number in each image, and the images.
_CLICKS = {
    "head": (3, NAMES),
    "neck": (2, NAMES),
    "shaft": (2, NAMES),
    "calcar": (1, NAMES[:1]),
    "cortex": (1, NAMES[:1]),
}


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


@cache
def marks_of(kind: str) -> tuple[MarkSpec, ...]:
    """Return all marks of a kind of trajectory, in the order in which the page asks for them. Raises
    UnusableInputError."""
    known = kind_of(kind)
    wire = [
        MarkSpec(name, _titled(point.name), point.sentence, "wire", name)
        for name, point in zip((ENTRY, END), known.points, strict=True)
    ]
    landmarks = [MarkSpec(f"landmark-{p.key}", _titled(p.name), p.sentence, "landmark", p.key) for p in known.landmarks]
    aids = []
    for aid in known.aids:
        clicks, images = _CLICKS[aid.key]
        for k in range(clicks):
            label = f"{_titled(aid.name)} {k + 1}" if clicks > 1 else _titled(aid.name)
            aids.append(MarkSpec(f"{aid.key}-{k + 1}", label, aid.sentence, "aid", aid.key, images))
    return (*wire, *landmarks, *aids)


def _titled(name: str) -> str:
    return name[:1].upper() + name[1:]


def names_of(kind: str, group: Group) -> tuple[str, ...]:
    """Return the names of one group's marks."""
    return tuple(spec.name for spec in marks_of(kind) if spec.group == group)
