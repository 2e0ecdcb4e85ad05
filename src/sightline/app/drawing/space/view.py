"""The 3-D scene as a NiceGUI element. It has no state: every change calls a method in the browser."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import nicegui.elements.scene  # noqa: F401 # pyright: ignore[reportUnusedImport] - makes its three.js known to the page; ours is no copy of it

from sightline.app.drawing.calls import Calling

_COLOURS = Path(__file__).parents[1] / "colours.js"
Objects = Sequence[Mapping[str, Any]]


class SpaceView(Calling, component="space_view.js", dependencies=["space*.js", _COLOURS]):
    """The 3-D scene. Its objects are those of `document`, in named groups that a person can hide."""

    def __init__(self, *, label: str, groups: Mapping[str, str], texts: Mapping[str, str]) -> None:
        """`label`: accessible description of the scene; `groups`: names of the groups, in the legend's order; `texts`:
        of its buttons and notes, by name."""
        super().__init__()
        self._props["label"] = label
        self._props["groups"] = dict(groups)
        self._props["texts"] = dict(texts)
        self._props["data-testid"] = "space"

    def draw(self, group: str, objects: Objects) -> None:
        """Replace one group; an empty one is removed."""
        self.run_method("draw", group, list(objects))

    def orient(self, side: str | None) -> None:
        """Set the side of the hip, "right" or "left", which orients the view: feet towards the viewer; from above, head
        up."""
        self.run_method("orient", side)
