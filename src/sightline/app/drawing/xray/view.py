"""The X-ray view as an element of NiceGUI; what its browser says is checked before anybody hears of it.

Coordinates are image pixels, (0, 0) the centre of the top-left pixel. Every change is one message that holds all that
the view shows. What a person does in the browser is shown there at once, and given up as soon as it is acknowledged:
from then on the newest message holds.
"""

import inspect
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

import numpy as np
from nicegui.element import Element
from nicegui.events import GenericEventArguments

_COLOURS = Path(__file__).parents[1] / "colours.js"
TEXT_KEYS = (
    *("fit", "window", "invert", "flip", "rotate", "reset", "maximise", "restore"),  # names of the buttons
    *("point", "snapped", "placing", "mirrored", "rotated", "stale", "readout", "outside", "edit_lost", "load_failed"),
    "off_field",
)
"""Texts that a view needs. Fields in braces: point {name} {u} {v}, placing {name}, rotated {degrees}, readout {u} {v}
{value}, edit_lost {name}."""

EventType = Literal[
    "place", "drag", "drop", "nudge", "select", "remove", "cancel", "display", "ready", "error", "refused"
]
_TYPES = frozenset(get_args(EventType)) - {"refused"}
_MOVES = frozenset({"place", "drag", "drop", "nudge"})
_EDITS = _MOVES - {"drag"}
_OF_A_POINT = _MOVES | {"select", "remove", "cancel"}
_ANSWERED = _MOVES | {"cancel", "display"}  # each has a number; the browser waits for its acknowledgement
_ON_AN_IMAGE = _MOVES | {"remove", "display"}  # what says nothing of another image than the one it was made on
_MARGIN_PX = 1.0  # the browser keeps points in the field; this much is rounding [ours]
_LONGEST_MESSAGE = 300  # characters of an error that are kept [ours]
_LARGEST = 2**31  # of any number: moves of one page would take 68 years at one a second [calc]
_GREY_LEVELS = 65536
_ROTATIONS = (0, 90, 180, 270)


@dataclass(frozen=True)
class Window:
    """Grey levels that are shown: black at centre - width / 2, white at centre + width / 2, in stored values."""

    centre: float
    width: float


@dataclass(frozen=True)
class Display:
    """How the image is drawn: mirrored left to right first, then turned clockwise by `rotation` degrees."""

    rotation: int
    mirrored: bool
    inverted: bool
    window: Window


@dataclass(frozen=True)
class Picture:
    """Where the browser gets an image's raw little-endian uint16 pixels, `height` rows of `width`. `window`: what a
    reset gives. `field`: corners (u, v) of the convex field that X-rays reach; None: the whole image."""

    url: str
    width: int
    height: int
    window: Window
    field: tuple[tuple[float, float], ...] | None = None

    def contains(self, uv: tuple[float, float], margin_px: float = 0.0) -> bool:
        """True if X-rays reach a pixel, or one within `margin_px` of it."""
        low, (u, v) = -0.5 - margin_px, uv
        if not (low <= u < self.width - low - 1 and low <= v < self.height - low - 1):
            return False
        if self.field is None:
            return True
        corners = np.array(self.field)
        along = np.roll(corners, -1, axis=0) - corners
        to = np.array(uv) - corners
        beside = (along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]) / np.linalg.norm(
            along, axis=1
        )  # clockwise on screen
        return bool((beside >= -margin_px).all())


@dataclass(frozen=True)
class Shown:
    """All that a view shows. `layers`: shapes by layer, drawn in this order (image pixels; styles are names of the
    table in xray_paint.js). `points`: id, label, uv (None: not placed), style, movable, snapped; only these may be
    named by the browser. `placing`: the point that the next click places. `notice`: a text over the image.
    `revision`: the state of the plan; an edit that was not acknowledged is sent again only under the same one."""

    label: str
    picture: Picture | None = None
    display: Display | None = None
    layers: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    points: Sequence[Mapping[str, Any]] = ()
    placing: str | None = None
    notice: str | None = None
    revision: str = ""

    def document(self) -> dict[str, Any]:
        """As JSON types."""
        of = {name: getattr(self, name) for name in ("label", "placing", "notice", "revision")}
        return {
            **of,
            "picture": None if self.picture is None else asdict(self.picture),
            "display": None if self.display is None else asdict(self.display),
            "layers": {name: list(shapes) for name, shapes in self.layers.items()},
            "points": [dict(point) for point in self.points],
        }


@dataclass(frozen=True)
class XrayEvent:
    """What a person did in the view, checked; "refused" stands for what was not what it must be. `uv` (u, v) px; `seq`
    numbers what the view acknowledges."""

    type: EventType
    id: str | None = None
    uv: tuple[float, float] | None = None
    seq: int | None = None
    display: Display | None = None
    message: str | None = None


Handler = Callable[["XrayView", XrayEvent], Awaitable[None] | None]


class XrayView(Element, component="xray_view.js", dependencies=["xray*.js", _COLOURS]):
    """An X-ray image in the browser, with layers of shapes and points to place and move."""

    def __init__(self, name: str, *, label: str, texts: Mapping[str, str]) -> None:
        """`name` is the view's key in the page, `label` what people call it. Raises KeyError if a text is missing."""
        said = {key: texts[key] for key in TEXT_KEYS}
        super().__init__()
        self.name = name
        self._props["name"] = name
        self._props["label"] = label
        self._props["texts"] = said
        self._props["data-testid"] = f"xray-{name}"
        self.refused = 0
        """Events of the browser that were dropped because they were not what they must be."""
        self.shown = Shown(label)
        """What the newest message says."""
        self._version = 0
        self._handler: Handler | None = None
        self.on("xray", self._hear)

    def on_event(self, handler: Handler) -> None:
        """`handler(view, event)`, plain or async, hears every event; there is one. What is shown once it has ended is
        the answer to the event."""
        self._handler = handler

    def show(self, shown: Shown, *, fresh_s: float | None = None) -> None:
        """Show exactly this. `fresh_s`: of a live image, for how long from here on it is what is now; unless that is
        said again, the browser then hides what belongs to the plan, and says so."""
        if shown != self.shown or self._version == 0:
            self.shown, self._version = shown, self._version + 1
            fresh_ms = None if fresh_s is None else 1000.0 * fresh_s
            self.run_method("show", {"version": self._version, "freshMs": fresh_ms, **shown.document()})
        elif fresh_s is not None and shown.picture is not None:
            self.run_method("setFresh", shown.picture.url, 1000.0 * fresh_s)

    def acknowledge(self, seq: int) -> None:
        """What was done under this number is answered: the newest message holds, and the next move may come."""
        self.run_method("acknowledge", seq)

    def drop(self, event: XrayEvent) -> None:
        """What was done is not taken, since another image is to be shown: the person is told."""
        self._say_lost(event.type, event.id)

    async def _hear(self, arguments: GenericEventArguments) -> None:
        said = arguments.args
        event = checked(said, self.shown)
        try:
            if event is None:
                self.refused += 1
            if self._handler is not None:
                answer = self._handler(self, event or XrayEvent("refused"))
                if inspect.isawaitable(answer):
                    await answer
        finally:  # what is refused must not hold up what comes behind it
            kind, name, seq = (said.get(key) if isinstance(said, dict) else None for key in ("type", "id", "seq"))
            if isinstance(kind, str) and kind in _ANSWERED and _is_seq(seq):
                self.acknowledge(seq)
                if event is None:
                    self._say_lost(kind, name)

    def _say_lost(self, kind: str, name: object) -> None:
        if kind in _EDITS and isinstance(name, str):
            self.run_method("sayLost", name)


def checked(said: object, shown: Shown) -> XrayEvent | None:
    """The event in what a browser said; None if it is not one, names an unknown point, lies off the field or was made
    on another image than the one that is shown."""
    kind = said.get("type") if isinstance(said, dict) else None
    if not isinstance(said, dict) or not isinstance(kind, str) or kind not in _TYPES:
        return None
    elsewhere = kind in _ON_AN_IMAGE and (shown.picture is None or said.get("image") != shown.picture.url)
    if elsewhere or (kind in _ANSWERED and not _is_seq(said.get("seq"))):
        return None
    if kind in _OF_A_POINT:
        return _of_a_point(kind, said, shown)
    if kind == "display":
        display = _display(said)
        return None if display is None else XrayEvent("display", seq=said["seq"], display=display)
    if kind == "error":
        message = said.get("message")
        return XrayEvent("error", message=_one_line(message)) if isinstance(message, str) else None
    return XrayEvent("ready")


def _of_a_point(kind: Any, said: dict[str, Any], shown: Shown) -> XrayEvent | None:
    name, seq = said.get("id"), said.get("seq") if kind in _ANSWERED else None
    if kind == "select" and name is None:
        return XrayEvent("select")  # nothing is selected any more
    if not isinstance(name, str) or name not in {point["id"] for point in shown.points}:
        return None
    if kind not in _MOVES:
        return XrayEvent(kind, name, seq=seq)
    uv = _place(said.get("uv"), shown.picture)
    return None if uv is None else XrayEvent(kind, name, uv, seq)


def _place(uv: object, picture: Picture | None) -> tuple[float, float] | None:
    if not isinstance(uv, list) or len(uv) != 2 or picture is None:
        return None
    u, v = (_number(value) for value in uv)
    if u is None or v is None or not picture.contains((u, v), _MARGIN_PX):
        return None
    return u, v


def _display(said: dict[str, Any]) -> Display | None:
    rotation, mirrored, inverted, window = (said.get(key) for key in ("rotation", "mirrored", "inverted", "window"))
    if type(rotation) is not int or rotation not in _ROTATIONS:
        return None
    if not (isinstance(mirrored, bool) and isinstance(inverted, bool) and isinstance(window, dict)):
        return None
    centre, width = _number(window.get("centre")), _number(window.get("width"))
    if centre is None or width is None or not (0 <= centre <= _GREY_LEVELS and 0 < width <= _GREY_LEVELS):
        return None
    return Display(rotation, mirrored, inverted, Window(centre, width))


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        return None  # not a number, infinite, or larger than anything here
    return float(value)


def _is_seq(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 < value < _LARGEST


def _one_line(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text[:_LONGEST_MESSAGE])
