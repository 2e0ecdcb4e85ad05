"""The X-ray view as an element of NiceGUI; what its browser says is checked before anybody hears of it.

Coordinates are image pixels, (0, 0) the centre of the top-left pixel. The element holds no state of the plan:
properties are first values only, every change is a call of a method in the browser.
"""

import inspect
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

from nicegui.element import Element
from nicegui.events import GenericEventArguments

_COLOURS = Path(__file__).parents[1] / "colours.js"
TEXT_KEYS = (
    *("fit", "window", "invert", "flip", "rotate", "reset", "maximise", "restore"),  # names of the buttons
    *("point", "snapped", "placing", "mirrored", "rotated", "stale", "readout", "outside", "edit_lost", "load_failed"),
)
"""Texts that a view needs. Fields in braces: point {name} {u} {v}, placing {name}, rotated {degrees}, readout {u} {v}
{value}, edit_lost {name}."""

EventType = Literal["place", "drag", "drop", "nudge", "select", "remove", "cancel", "display", "ready", "error"]
_TYPES = frozenset(get_args(EventType))
_MOVES = frozenset({"place", "drag", "drop", "nudge"})
_EDITS = _MOVES - {"drag"}
_OF_A_POINT = _MOVES | {"select", "remove", "cancel"}
_ON_AN_IMAGE = _MOVES | {"remove", "display"}  # what says nothing of another image than the one it was made on
_MARGIN_PX = 1.0  # the browser keeps points on the image; this much is rounding [ours]
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
class XrayEvent:
    """What a person did in the view, checked. `uv` (u, v) px; `seq` numbers moves and is to be acknowledged."""

    type: EventType
    id: str | None = None
    uv: tuple[float, float] | None = None
    seq: int | None = None
    display: Display | None = None
    message: str | None = None


Handler = Callable[["XrayView", XrayEvent], Awaitable[None] | None]


@dataclass
class Bounds:
    """What a client may name: the image that is shown, its size (px) and the points there are."""

    image: str | None = None
    width: int = 0
    height: int = 0
    ids: set[str] = field(default_factory=set)


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
        self._bounds = Bounds()
        self._points: list[Mapping[str, Any]] = []
        self._handler: Handler | None = None
        self.on("xray", self._hear)

    def on_event(self, handler: Handler) -> None:
        """`handler(view, event)`, plain or async, hears every event; there is one."""
        self._handler = handler

    # ------------------------------------------------------------------------------------------------- what is shown

    def set_image(
        self,
        url: str,
        width: int,
        height: int,
        *,
        window: Window,
        inverted: bool = False,
        fresh_s: float | None = None,
    ) -> None:
        """Show the raw little-endian uint16 pixels at `url`, `height` rows of `width`. What was done on another image
        and is on its way here is dropped from now on. `fresh_s`: of a live image, as `fresh_for` has it."""
        self._bounds.image, self._bounds.width, self._bounds.height = url, width, height
        image = {"url": url, "width": width, "height": height, "window": asdict(window), "inverted": inverted}
        self.run_method("setImage", {**image, "freshMs": None if fresh_s is None else 1000.0 * fresh_s})

    def set_label(self, label: str) -> None:
        """What people call the image that is shown."""
        self.run_method("setLabel", label)

    def draw(self, layer: str, shapes: Sequence[Mapping[str, Any]]) -> None:
        """Replace `layer` by `shapes` (image pixels; styles are names of the table in xray_paint.js)."""
        self.run_method("setLayer", layer, list(shapes))

    def show_layer(self, layer: str, on: bool) -> None:
        """Show or hide `layer`."""
        self.run_method("showLayer", layer, on)

    def set_points(self, points: Sequence[Mapping[str, Any]]) -> None:
        """Replace the points: id, label, uv (None: not placed yet), style, movable, snapped.

        Only points that are listed here, placed or not, may be named by the browser.
        """
        self._points = list(points)
        self._bounds.ids = {str(point["id"]) for point in points}
        self.run_method("setPoints", self._points)

    def move_point(self, name: str, uv: Sequence[float]) -> None:
        """Move a point to `uv` (px), unless the person holds it or has moved it since."""
        self.run_method("movePoint", name, [float(value) for value in uv])

    def follow(self, layers: Mapping[str, Sequence[Mapping[str, Any]]], points: Mapping[str, Sequence[float]]) -> None:
        """`draw` each of the layers and `move_point` each of the points, in one message: fast enough for a drag."""
        moved = {name: [float(value) for value in uv] for name, uv in points.items()}
        self.run_method("follow", {name: list(shapes) for name, shapes in layers.items()}, moved)

    def place(self, name: str | None) -> None:
        """Let the next click place the point `name`; None: no longer."""
        if name is not None:
            self._bounds.ids.add(name)
        self.run_method("place", name)

    def set_display(
        self,
        *,
        rotation: int | None = None,
        mirrored: bool | None = None,
        inverted: bool | None = None,
        window: Window | None = None,
    ) -> None:
        """Change what is given of how the image is drawn. Raises ValueError if `rotation` is no quarter turn."""
        if rotation is not None and rotation not in _ROTATIONS:
            raise ValueError(f"rotation is 0, 90, 180 or 270 degrees, not {rotation}")
        shown = None if window is None else asdict(window)
        self.run_method(
            "setDisplay", {"rotation": rotation, "mirrored": mirrored, "inverted": inverted, "window": shown}
        )

    def notice(self, text: str | None) -> None:
        """Show `text` over the image; None: nothing."""
        self.run_method("setNotice", text)

    def fresh_for(self, seconds: float | None) -> None:
        """The image is what is now for so long from here on; unless that is said again, the browser then hides what
        belongs to the plan, and says so. None: it is no live image and does not grow old."""
        self.run_method("setFresh", self._bounds.image, None if seconds is None else 1000.0 * seconds)

    # ----------------------------------------------------------------------------------------------- what is answered

    def acknowledge(self, seq: int) -> None:
        """The move `seq` is done, its consequences drawn: the browser may send the next."""
        self.run_method("acknowledge", seq)

    def drop(self, event: XrayEvent) -> None:
        """What was done is not taken, since another image is to be shown: a point goes back, the person is told."""
        self._release(asdict(event))

    def set_revision(self, revision: int | str) -> None:
        """Say which state of the plan the page shows; once when the page is built and after every change.

        An edit that was not acknowledged is sent again only under the same one."""
        self.run_method("setRevision", revision)

    async def _hear(self, arguments: GenericEventArguments) -> None:
        event = checked(arguments.args, self._bounds)
        if event is None:
            self.refused += 1
            self._release(arguments.args)
        elif self._handler is not None:
            answer = self._handler(self, event)
            if inspect.isawaitable(answer):
                await answer

    def _release(self, said: object) -> None:
        # A refused move must not hold up those behind it.
        kind, name, seq = (said.get(key) if isinstance(said, dict) else None for key in ("type", "id", "seq"))
        if _is_seq(seq):
            self.acknowledge(seq)
            if isinstance(kind, str) and kind in _EDITS and isinstance(name, str):
                self.run_method("setPoints", self._points)  # the browser has moved it already
                self.run_method("sayLost", name)


def checked(said: object, bounds: Bounds) -> XrayEvent | None:
    """The event in what a browser said; None if it is not one, names an unknown point, lies off the image or was made
    on another image than the one that is shown."""
    kind = said.get("type") if isinstance(said, dict) else None
    if not isinstance(said, dict) or not isinstance(kind, str) or kind not in _TYPES:
        return None
    if kind in _ON_AN_IMAGE and said.get("image") != bounds.image:
        return None
    if kind in _OF_A_POINT:
        return _of_a_point(kind, said, bounds)
    if kind == "display":
        display = _display(said)
        return None if display is None else XrayEvent("display", display=display)
    if kind == "error":
        message = said.get("message")
        return XrayEvent("error", message=_one_line(message)) if isinstance(message, str) else None
    return XrayEvent("ready")


def _of_a_point(kind: Any, said: dict[str, Any], bounds: Bounds) -> XrayEvent | None:
    name = said.get("id")
    if kind == "select" and name is None:
        return XrayEvent("select")  # nothing is selected any more
    if not isinstance(name, str) or name not in bounds.ids:
        return None
    if kind not in _MOVES:
        return XrayEvent(kind, name)
    uv, seq = _place(said.get("uv"), bounds), said.get("seq")
    return XrayEvent(kind, name, uv, seq) if uv is not None and _is_seq(seq) else None


def _place(uv: object, bounds: Bounds) -> tuple[float, float] | None:
    if not isinstance(uv, list) or len(uv) != 2 or not bounds.width:
        return None
    u, v = (_number(value) for value in uv)
    low = -0.5 - _MARGIN_PX
    if u is None or v is None or not (low <= u < bounds.width - low - 1 and low <= v < bounds.height - low - 1):
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
