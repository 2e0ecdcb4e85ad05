"""The scene as an element of NiceGUI. It holds nothing: every change is a call of a method in the browser."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import nicegui.elements.scene  # noqa: F401 # pyright: ignore[reportUnusedImport] - makes its three.js known to the page; ours is no copy of it
from nicegui.element import Element

_COLOURS = Path(__file__).parents[1] / "colours.js"
TEXTS = {
    "feet": "From the feet",
    "side": "From the side",
    "above": "From above",
    "hip": "Hip",
    "frame": "Frame",
    "room": "Room",
    "keys": "Arrow keys turn it, with shift they move it, plus and minus come nearer.",
    "none": "This browser shows no 3-D graphics (WebGL). Planning needs none: all else on this page works.",
}

Objects = Sequence[Mapping[str, Any]]


class SpaceView(Element, component="space_view.js", dependencies=["space*.js", _COLOURS]):
    """The set-up in space. Objects are those of `space_document`, in named groups that a person can hide."""

    def __init__(self, *, label: str, groups: Mapping[str, str]) -> None:
        """`label` says what is shown to who cannot see it; `groups` are the groups' words, in the legend's order."""
        super().__init__()
        self._props["label"] = label
        self._props["groups"] = dict(groups)
        self._props["texts"] = TEXTS
        self._props["data-testid"] = "space"

    def draw(self, group: str, objects: Objects) -> None:
        """Replace one group; an empty one goes."""
        self.run_method("draw", group, list(objects))

    def orient(self, side: str | None) -> None:
        """Say which hip it is, "right" or "left": the feet are then towards the viewer; from above, the head is up."""
        self.run_method("orient", side)
