"""Which points a person may place for a kind of trajectory, in the order that the page asks for them."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

from sightline.case.views import NAMES
from sightline.planning.kinds import kind as kind_of

Group = Literal["wire", "landmark", "aid"]
CHECK_NAMES = (f"check-{NAMES[0]}", f"check-{NAMES[1]}")
ENTRY, END = "entry", "end"
# What an aid is drawn with: how many clicks in each image, and in which images.
_CLICKS = {
    "head": (3, NAMES),
    "neck": (2, NAMES),
    "shaft": (2, NAMES),
    "calcar": (1, NAMES[:1]),
    "cortex": (1, NAMES[:1]),
}


@dataclass(frozen=True)
class Asked:
    """One point to place. `of`: the point of the wire, the landmark or the aid that it belongs to; `images`: where."""

    name: str
    label: str
    sentence: str
    group: Group
    of: str
    images: tuple[str, ...] = NAMES


@cache
def asked_of(kind: str) -> tuple[Asked, ...]:
    """All points of a kind of trajectory, in the order they are asked for. Raises UnusableInputError."""
    known = kind_of(kind)
    wire = [
        Asked(name, _titled(point.name), point.sentence, "wire", name)
        for name, point in zip((ENTRY, END), known.points, strict=True)
    ]
    landmarks = [Asked(f"landmark-{p.key}", _titled(p.name), p.sentence, "landmark", p.key) for p in known.landmarks]
    aids = []
    for aid in known.aids:
        clicks, images = _CLICKS[aid.key]
        for k in range(clicks):
            label = f"{_titled(aid.name)} {k + 1}" if clicks > 1 else _titled(aid.name)
            aids.append(Asked(f"{aid.key}-{k + 1}", label, aid.sentence, "aid", aid.key, images))
    return (*wire, *landmarks, *aids)


def _titled(name: str) -> str:
    return name[:1].upper() + name[1:]


def names_of(kind: str, group: Group) -> tuple[str, ...]:
    """The names of one group's points."""
    return tuple(asked.name for asked in asked_of(kind) if asked.group == group)
