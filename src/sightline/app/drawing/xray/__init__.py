"""The X-ray view as a NiceGUI element; events from the browser are validated before they are handled.

Coordinates are image pixels, (0, 0) the centre of the top-left pixel. Every change is one message with the complete
content of the view, but for what is as in the message before. The browser shows a person's action at once; when the
action is acknowledged, the newest message replaces it.
"""

import inspect
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeGuard, TypeVar, get_args

import numpy as np
from nicegui.events import GenericEventArguments
from pydantic import Field, StrictBool, TypeAdapter, ValidationError

from sightline.app.drawing.calls import Calling
from sightline.common.geometry.lines import unit

T = TypeVar("T")
_COLOURS = Path(__file__).parents[1] / "colours.js"
PRESETS = ("bone", "metal", "beads")
"""Names of the windows for what a person looks at."""
TEXT_KEYS = (
    *("fit", "link", "measure", "window", "invert", "flip", "rotate", "reset"),  # names of the buttons
    *("maximise", "restore"),
    *PRESETS,
    *("head_up", "head_right", "head_down", "head_left"),
    *("point", "snapped", "placing", "mirrored", "rotated", "stale", "readout", "outside", "edit_lost", "load_failed"),
    *("off_field", "held_in_field"),
)
"""Texts that a view needs. Their fields: point {name} {u} {v}, placing {name}, rotated {degrees}, readout {u} {v}
{value}, edit_lost {name}."""

EventType = Literal[
    "place", "drag", "drop", "nudge", "select", "remove", "cancel", "display", "measure", "ready", "error", "refused"
]
_TYPES = frozenset(get_args(EventType)) - {"refused"}
_MOVES = frozenset({"place", "drag", "drop", "nudge"})
_EDITS = _MOVES - {"drag"}
_OF_A_POINT = _MOVES | {"select", "remove", "cancel"}
_ANSWERED = _MOVES | {"cancel", "display"}  # each has a number; the browser waits for its acknowledgement
_ON_AN_IMAGE = _MOVES | {"remove", "display", "measure"}  # valid only for the image on which they were made
_MARGIN_PX = 1.0  # tolerance for rounding; the browser keeps points in the field [ours]
_MAX_MESSAGE = 300  # [ours] characters of an error that are kept: a sentence and a place, in a log of many
_MAX_NUMBER = 2**31  # largest number: moves of one page at one a second would take 68 years [calc]
_GREY_LEVELS = 65536


@dataclass(frozen=True)
class Window:
    """Grey-level window: black at centre - width / 2, white at centre + width / 2, in stored values."""

    centre: Annotated[float, Field(strict=True, ge=0, le=_GREY_LEVELS)]
    width: Annotated[float, Field(strict=True, gt=0, le=_GREY_LEVELS)]


@dataclass(frozen=True)
class XrayDisplay:
    """How the image is drawn: mirrored left to right first, then rotated clockwise by `rotation` degrees."""

    rotation: Annotated[int, Field(strict=True, ge=0, lt=360, multiple_of=90)]
    mirrored: StrictBool
    inverted: StrictBool
    window: Window


@dataclass(frozen=True)
class XrayPicture:
    """Address of an image's raw little-endian uint16 pixels, `height` rows of `width`. `window`: the default, which a
    reset restores. `field`: corners (u, v) of the convex field that X-rays reach; None: the whole image. `presets`:
    windows for what a person looks at, by the names in PRESETS."""

    url: str
    width: int
    height: int
    window: Window
    field: tuple[tuple[float, float], ...] | None = None
    presets: tuple[tuple[str, Window], ...] = ()

    @cached_property
    def document(self) -> dict[str, Any]:
        """The picture as JSON types."""
        return asdict(self) | {"presets": {name: asdict(window) for name, window in self.presets}}

    def contains(self, uv: tuple[float, float], margin_px: float = 0.0) -> bool:
        """Return True if X-rays reach a pixel, or one within `margin_px` of it."""
        low, (u, v) = -0.5 - margin_px, uv
        if not (low <= u < self.width - low - 1 and low <= v < self.height - low - 1):
            return False
        if self.field is None:
            return True
        return all(a * u + b * v + c >= -margin_px for a, b, c in self._sides)

    @cached_property
    def _sides(self) -> list[tuple[float, float, float]]:
        """For each side of the field (a, b, c): a u + b v + c is the distance (px) of (u, v) from it, inwards."""
        corners = np.array(self.field)
        along = unit(np.roll(corners, -1, axis=0) - corners)  # clockwise on the screen
        offset = along[:, 1] * corners[:, 0] - along[:, 0] * corners[:, 1]
        return [(-dv, du, c) for (du, dv), c in zip(along.tolist(), offset.tolist(), strict=True)]


@dataclass(frozen=True)
class XrayContent:
    """The complete content of a view.

    `layers`: shapes by layer, drawn in this order (image pixels; styles as in the table in xray_paint.js). `points`:
    id, label, uv (None: not placed), style, movable, snapped (it lies on its curve), slides (a click takes it there);
    events may name only these. `placing`: the point that the next click places. `notice`: a text over the image.
    `revision`: of the plan; an edit that was not acknowledged is sent again only for the same revision. `matching`:
    {"from": name, "title": text with {name}, "sights": [address, address]}: the view whose points' image-matching
    curves are drawn here while they move, and the addresses of the maps (`sight`) of both, its first. `head`: direction
    of the patient's head in the image, degrees clockwise from up: 0, 90, 180 or 270; None: unknown. `identity`: whose
    image it is, under its title.
    """

    label: str
    picture: XrayPicture | None = None
    display: XrayDisplay | None = None
    layers: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    points: Sequence[Mapping[str, Any]] = ()
    placing: str | None = None
    notice: str | None = None
    revision: str = ""
    matching: Mapping[str, Any] | None = None
    head: int | None = None
    identity: str = ""

    def document(self, before: "XrayContent | None" = None) -> dict[str, Any]:
        """Return the content as JSON types; with `before` only what differs from it, and for each layer that is the
        same list of shapes, None."""
        known = {} if before is None else before.layers
        news = [name for name in _MEMBERS if before is None or getattr(self, name) != getattr(before, name)]
        return {name: _as_json(getattr(self, name)) for name in news} | {
            "layers": {name: None if known.get(name) is drawn else list(drawn) for name, drawn in self.layers.items()}
        }


_MEMBERS = ("label", "picture", "display", "points", "placing", "notice", "revision", "matching", "head", "identity")


def _as_json(value: Any) -> Any:
    """Return a member of the content, but layers, as JSON types."""
    if isinstance(value, XrayPicture):
        return value.document
    return asdict(value) if isinstance(value, XrayDisplay) else value


@dataclass(frozen=True)
class XrayEvent:
    """A validated action of a person; "refused" stands for an invalid event. `uv` (u, v) px; `seq`: number for the
    acknowledgement. `points`: two or three clicks of the ruler, none where it was taken away."""

    type: EventType
    id: str | None = None
    uv: tuple[float, float] | None = None
    seq: int | None = None
    display: XrayDisplay | None = None
    message: str | None = None
    points: tuple[tuple[float, float], ...] = ()


Handler = Callable[["XrayView", XrayEvent], Awaitable[None] | None]


class XrayView(Calling, component="xray_view.js", dependencies=["xray*.js", _COLOURS]):
    """An X-ray image in the browser, with layers of shapes and points to place and move."""

    def __init__(self, name: str, *, label: str, texts: Mapping[str, str]) -> None:
        """`name`: the view's key in the page; `label`: its title. Raises KeyError if a text is missing."""
        named = {key: texts[key] for key in TEXT_KEYS}
        super().__init__()
        self.name = name
        self._props["name"] = name
        self._props["label"] = label
        self._props["texts"] = named
        self._props["data-testid"] = f"xray-{name}"
        self.refused = 0
        """Number of invalid events from the browser."""
        self.shown = XrayContent(label)
        """The content of the newest message."""
        self._version = 0
        self._handler: Handler | None = None
        self.on("xray", self._hear)

    def on_event(self, handler: Handler) -> None:
        """Set the handler, `handler(view, event)`, plain or async, for all events. The content once it has ended is the
        answer to the event."""
        self._handler = handler

    def show(self, shown: XrayContent, *, fresh_s: float | None = None) -> None:
        """Show this content. `fresh_s`: for a live image, how long from now it counts as current; unless extended by
        another call, the browser then hides the plan and says so."""
        if shown != self.shown or self._version == 0:
            news = shown.document(self.shown if self._version else None)
            self.shown, self._version = shown, self._version + 1
            fresh_ms = None if fresh_s is None else 1000.0 * fresh_s
            self.run_method("show", {"version": self._version, "freshMs": fresh_ms, **news})
        elif fresh_s is not None and shown.picture is not None:
            self.run_method("setFresh", shown.picture.url, 1000.0 * fresh_s)

    def acknowledge(self, seq: int) -> None:
        """Acknowledge the action of this number: the newest message holds, and the next move may come."""
        self.run_method("acknowledge", seq)

    def say_measured(self, label: str, note: str) -> None:
        """Show what the ruler measured, and under the image's title what that means."""
        self.run_method("measured", label, note)

    def drop(self, event: XrayEvent) -> None:
        """Reject an action because the view now shows another image, and tell the person."""
        self._say_lost(event.type, event.id)

    async def _hear(self, arguments: GenericEventArguments) -> None:
        message = arguments.args
        event = checked(message, self.shown)
        try:
            if event is None:
                self.refused += 1
            if self._handler is not None:
                answer = self._handler(self, event or XrayEvent("refused"))
                if inspect.isawaitable(answer):
                    await answer
        finally:  # a refused event must not block later ones
            kind, name, seq = (message.get(key) if isinstance(message, dict) else None for key in ("type", "id", "seq"))
            if isinstance(kind, str) and kind in _ANSWERED and _is_seq(seq):
                self.acknowledge(seq)
                if event is None:
                    self._say_lost(kind, name)

    def _say_lost(self, kind: str, name: object) -> None:
        if kind in _EDITS and isinstance(name, str):
            self.run_method("sayLost", name)


def checked(message: object, shown: XrayContent) -> XrayEvent | None:
    """Return the event in a browser's message; None if it is invalid, names an unknown point, lies outside the field or
    was made on another image than the one shown."""
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(message, dict) or not isinstance(kind, str) or kind not in _TYPES:
        return None
    elsewhere = kind in _ON_AN_IMAGE and (shown.picture is None or message.get("image") != shown.picture.url)
    if elsewhere or (kind in _ANSWERED and not _is_seq(message.get("seq"))):
        return None
    if kind in _OF_A_POINT:
        return _of_a_point(kind, message, shown)
    read = {"measure": _measure, "display": _displayed, "error": _error}.get(kind)
    return XrayEvent("ready") if read is None else read(message, shown)


def _of_a_point(kind: Any, message: dict[str, Any], shown: XrayContent) -> XrayEvent | None:
    name, seq = message.get("id"), message.get("seq") if kind in _ANSWERED else None
    if kind == "select" and name is None:
        return XrayEvent("select")  # nothing is selected any more
    if not isinstance(name, str) or name not in {point["id"] for point in shown.points}:
        return None
    if kind not in _MOVES:
        return XrayEvent(kind, name, seq=seq)
    uv = _place(message.get("uv"), shown.picture)
    return None if uv is None else XrayEvent(kind, name, uv, seq)


def _place(uv: object, picture: XrayPicture | None) -> tuple[float, float] | None:
    at = _read(_PIXEL, uv)
    return at if at is not None and picture is not None and picture.contains(at, _MARGIN_PX) else None


def _measure(message: dict[str, Any], shown: XrayContent) -> XrayEvent | None:
    clicks = _read(_CLICKS, message.get("points"))
    if clicks is None or len(clicks) not in {0, 2, 3} or None in [_place(click, shown.picture) for click in clicks]:
        return None
    return XrayEvent("measure", points=tuple(clicks))


def _displayed(message: dict[str, Any], _: XrayContent) -> XrayEvent | None:
    display = _read(_DISPLAY, message)
    return None if display is None else XrayEvent("display", seq=message["seq"], display=display)


def _error(news: dict[str, Any], _: XrayContent) -> XrayEvent | None:
    message = news.get("message")
    if not isinstance(message, str):
        return None
    return XrayEvent(
        "error", message="".join(letter if letter.isprintable() else " " for letter in message[:_MAX_MESSAGE])
    )


_Coordinate = Annotated[float, Field(strict=True, gt=-_MAX_NUMBER, lt=_MAX_NUMBER)]
_PIXEL = TypeAdapter(tuple[_Coordinate, _Coordinate])
_CLICKS = TypeAdapter(list[tuple[_Coordinate, _Coordinate]])
_DISPLAY = TypeAdapter(XrayDisplay)


def _read(adapter: TypeAdapter[T], value: object) -> T | None:
    """Return a value of a message; None if it is of another form, not finite, or larger than anything here."""
    try:
        return adapter.validate_python(value)
    except ValidationError:
        return None


def _is_seq(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 < value < _MAX_NUMBER
