"""A page with two X-ray views, for tests and figures: `python -m tests.app.xray_page PORT SECONDS REVISION`.

The image is `picture()`. Moves of a point are answered after SECONDS of waiting with a curve in the
other view. What the views heard is served as JSON under /heard until /forget; /do/NAME calls one of `COMMANDS`.
"""

import asyncio
import functools
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from fastapi import Response
from nicegui import app, ui

from sightline.app.drawing.xray import Window, XrayContent, XrayDisplay, XrayEvent, XrayPicture, XrayView
from sightline.app.texts import XRAY as TEXTS

SIDE = 1024
WINDOW = Window(32768.0, 65536.0)
FIELD_PX = 0.49 * SIDE  # radius of the round field
_TURNS = np.arange(64) * 2 * np.pi / 64
FIELD = tuple((SIDE / 2 + FIELD_PX * float(np.cos(t)), SIDE / 2 + FIELD_PX * float(np.sin(t))) for t in _TURNS)
PICTURE = XrayPicture("/picture", SIDE, SIDE, WINDOW, FIELD, (("bone", Window(16000.0, 9000.0)),))
DISPLAY = XrayDisplay(0, False, False, WINDOW)
SPOTS = [(200.3, 300.7), (511.5, 512.25), (800.6, 150.4), (350.2, 850.9)]
"""Bright spots, off the grid: what a place on the screen is measured by."""
POINTS: list[dict[str, Any]] = [
    {"id": "entry", "label": "Entry", "uv": (300.0, 400.0), "style": "landmark"},
    {"id": "end", "label": "End", "uv": (700.0, 600.0), "style": "landmark", "snapped": True},
    {"id": "fixed", "label": "Ball 7", "uv": (512.0, 200.0), "style": "found", "movable": False},
    {"id": "aim", "label": "Aim", "uv": None, "style": "landmark"},
]
HOSTILE = "<img src=x onerror='window.hacked=1'>"


@functools.cache
def picture() -> np.ndarray:
    """(1024, 1024) uint16: flat in the round field of an intensifier (no slope shifts a spot), a disc and `SPOTS`."""
    v, u = np.mgrid[0:SIDE, 0:SIDE].astype(np.float64)
    values = np.full((SIDE, SIDE), 15000.0)
    values[np.hypot(u - 650, v - 720) < 90] += 6000.0
    for spot_u, spot_v in SPOTS:
        values += 30000.0 * np.exp(-((u - spot_u) ** 2 + (v - spot_v) ** 2) / (2 * 5.0**2))
    values[np.hypot(u - SIDE / 2, v - SIDE / 2) > FIELD_PX] = 0.0
    return values.astype("<u2")


def curve(uv: tuple[float, float]) -> dict[str, Any]:
    """A curve of 60 points that hangs on `uv`."""
    t = np.linspace(-0.4, 0.4, 60)
    points = np.stack([uv[0] + SIDE * t, uv[1] + 400 * t**2 + 90 * t], axis=1)
    return {"shape": "line", "points": points.tolist(), "style": "curve", "title": "matching curve"}


def _sight(focal_mm: list[float], origin_mm: list[float], axes: list[list[float]]) -> dict[str, Any]:
    """The map of a pinhole camera, 5 px/mm on a plane 1 m away, (512, 512) at the plane's origin."""

    def grid(low: float, step: float, value: Callable[[float], float]) -> dict[str, Any]:
        nodes = [low + step * k for k in range(36)]
        values = [[value(x), value(y)] for y in nodes for x in nodes]
        return {"start": [low, low], "step": [step, step], "count": 36, "values": values}

    return {
        "focal": focal_mm,
        "origin": origin_mm,
        "axes": axes,
        "toPlane": grid(-100.0, 40.0, lambda px: (px - 512.0) / 5.0),
        "toImage": grid(-130.0, 8.0, lambda mm: 512.0 + 5.0 * mm),
        "sides": [[1, 0, -1000], [-1, 0, 0], [0, 1, -1000], [0, -1, 0]],
        "reach": 20.0,
    }


SIGHTS = {
    "pa": _sight([0.0, 0.0, -600.0], [0.0, 0.0, 400.0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "lateral": _sight([-600.0, 0.0, 0.0], [400.0, 0.0, 0.0], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


def lateral_column(uv: tuple[float, float], row: Any) -> Any:
    """The column at which the lateral view shows the line of sight of a pixel of the PA view, in a row."""
    (x, y), w = ((at - 512.0) / 5.0 for at in uv), (row - 512.0) / 5.0
    share = (w * x + 600.0 * w - 400_000.0) / (w * x - 1e6)  # of the line's way to the focal point
    return 512.0 + 5.0 * 1000.0 / (x * (1.0 - share) + 600.0) * y * (1.0 - share)


def beads(count: int = 120) -> list[dict[str, Any]]:
    """Beads in a ring, coloured by a residual that grows around it."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 330 + 110 * (np.arange(count) % 2)
    uv = np.stack([512 + radius * np.cos(angle), 512 + radius * np.sin(angle)], axis=1)
    return [
        {
            "shape": "circle",
            "points": [place.tolist()],
            "radius": 9,
            "style": "bead-good",
            "value": index / (count - 1),
            "title": f"bead {index}",
        }
        for index, place in enumerate(uv)
    ]


def gallery() -> list[dict[str, Any]]:
    """One of each shape and style."""
    line = [[420.0 + 6 * k, 380.0 + 3 * k] for k in range(40)]
    return [
        {"shape": "band", "points": line, "halfWidth": [8 + 0.5 * k for k in range(40)], "style": "corridor"},
        {"shape": "band", "points": line, "halfWidth": 4, "style": "wire"},
        {"shape": "band", "points": [[150, 620], [400, 660], [760, 700]], "halfWidth": 10, "style": "curve-band"},
        {"shape": "line", "points": [[150, 620], [400, 660], [760, 700]], "style": "curve", "label": "entry"},
        {
            "shape": "ticks",
            "points": [[150 + 61 * k, 620 + 8 * k] for k in range(11)],
            "style": "tick",
            "label": [str(10 * k) if k % 5 == 0 else "" for k in range(11)],
        },
        {"shape": "polygon", "points": [[600, 250], [700, 260], [720, 360], [620, 380]], "style": "plan"},
        {"shape": "circle", "points": [[300, 250]], "radius": 60, "style": "aid", "title": HOSTILE},
        {"shape": "dots", "points": [[250, 500], [270, 510], [290, 505]], "style": "found"},
        {"shape": "cross", "points": [[820, 480], [840, 520]], "style": "rejected", "title": "rejected: too faint"},
        {"shape": "circle", "points": [[860, 600]], "radius": 10, "style": "bead-warn"},
        {"shape": "circle", "points": [[840, 660]], "radius": 10, "style": "bead-bad"},
        {"shape": "circle", "points": [[800, 720]], "style": "focus", "label": "centre"},
        {"shape": "line", "points": [[200, 760], [500, 800]], "style": "stale"},
        {"shape": "text", "points": [[430, 900]], "style": "landmark", "label": HOSTILE},
    ]


WIRE_PX = [[300.0, 700.0], [700.0, 700.0]]
WIRE = [{"shape": "band", "points": WIRE_PX, "halfWidth": 4, "style": "wire"}]
pages: list[dict[str, XrayView]] = []  # the two views of each page that is open
heard: list[dict[str, Any]] = []
state: dict[str, int] = {"revision": 1, "answering": True, "taking": True}


class View(XrayView):
    """Answers a move after `seconds`, with a curve in the other view, or not at all."""

    def acknowledge(self, seq: int) -> None:
        if state["answering"]:
            super().acknowledge(seq)


def page(seconds: float) -> None:
    views: dict[str, XrayView] = {}
    pages.append(views)
    ui.context.client.on_delete(lambda: pages.remove(views))

    async def hear(view: XrayView, event: XrayEvent) -> None:
        if event.type == "refused":
            return
        name = "pa" if view is views["pa"] else "lateral"
        heard.append({"view": name, **asdict(event)})
        if event.type == "display":
            change(view, display=event.display)
        elif event.type == "cancel":
            change(view, placing=None)
        if event.uv is None or event.seq is None or not state["answering"]:
            return
        await asyncio.to_thread(time.sleep, seconds)
        other = views["lateral" if name == "pa" else "pa"]
        draw(other, "curve", [{**curve(event.uv), "of": event.seq}])
        if event.type != "drag" and state["taking"]:
            points = [point | {"uv": event.uv} if point["id"] == event.id else point for point in view.shown.points]
            change(view, points=points, placing=None)

    ui.dark_mode(True)
    ui.query(".nicegui-content").style("padding: 0; gap: 0")
    with ui.element("div").style("display: flex; gap: 8px; padding: 8px; width: 100vw; height: 100vh"):
        for name, label in (("pa", "PA image"), ("lateral", "Lateral image")):
            with ui.element("div").style("flex: 1; min-width: 0").classes(f"box-{name}"):
                views[name] = view = View(name, label=label, texts=TEXTS)
            view.on_event(hear)
            view.show(XrayContent(label, PICTURE, DISPLAY, points=POINTS, revision=str(state["revision"])))


def beside(view: XrayView) -> dict[str, XrayView]:
    """The views of the page that a view is of."""
    return next(page for page in pages if view in page.values())


def change(view: XrayView, **news: Any) -> None:
    """Show something else."""
    view.show(replace(view.shown, **news))


def draw(view: XrayView, layer: str, shapes: list[dict[str, Any]] | None) -> None:
    """A layer anew, or without shapes none."""
    others = {name: drawn for name, drawn in view.shown.layers.items() if name != layer}
    change(view, layers=others if shapes is None else {**others, layer: shapes})


def show_as(view: XrayView, address: str, **news: Any) -> None:
    """The picture under another address."""
    change(view, picture=replace(PICTURE, url=address), **news)


def restore(view: XrayView) -> None:
    """The view as it was built, and nothing heard."""
    for one in heard:
        if one["seq"]:
            XrayView.acknowledge(view, one["seq"])
    change(view, notice="restored")
    change(view, picture=PICTURE, display=DISPLAY, layers={}, points=POINTS, placing=None, notice=None, head=None)
    change(beside(view)["lateral"], points=POINTS, placing=None, matching=None)
    view.refused = 0
    state["taking"] = True


def once_more(view: XrayView) -> None:
    """A message that was sent before, after a newer one."""
    view.run_method("show", {"version": 1, "freshMs": None, **replace(view.shown, points=[]).document()})


def say_again(seconds: float) -> Callable[[XrayView], None]:
    return lambda view: view.show(view.shown, fresh_s=seconds)


def match(view: XrayView) -> None:
    """The lateral view draws the curves of the PA view's points; a click slides `aim` onto its own."""
    change(view, points=[*POINTS[:3], POINTS[3] | {"uv": (650.3, 480.2)}])
    maps = {"from": "pa", "title": "of {name}", "sights": ["/sight/pa", "/sight/lateral"]}
    change(beside(view)["lateral"], matching=maps, points=[*POINTS[:3], POINTS[3] | {"slides": True}])


def refuse(view: XrayView) -> None:
    """What is done from now on changes nothing."""
    state["taking"] = False


COMMANDS: dict[str, Callable[[XrayView], None]] = {
    "restore": restore,
    "refuse": refuse,
    "matching": match,
    "place": lambda view: change(view, placing="aim"),
    "place-lateral": lambda view: change(beside(view)["lateral"], placing="aim"),
    "beads": lambda view: draw(view, "beads", beads()),
    "gallery": lambda view: draw(view, "gallery", gallery()),
    "dim": lambda view: change(view, points=[point | {"uv": None} for point in POINTS]),
    "hide": lambda view: draw(view, "gallery", None),
    "wire": lambda view: draw(view, "wire", WIRE),
    "drilled": lambda view: draw(
        view, "drilled", [{"shape": "line", "points": WIRE_PX, "style": "found", "legend": "as seen"}]
    ),
    "stale": say_again(0.0),
    "fresh": say_again(600.0),
    "fresh-shortly": say_again(0.5),
    "late": lambda view: view.show(replace(view.shown, picture=replace(PICTURE, url="/late")), fresh_s=0.5),
    "other": lambda view: show_as(view, "/picture?other"),
    "notice": lambda view: change(view, notice="The image is 0.4 s old"),
    "no-notice": lambda view: change(view, notice=None),
    "head": lambda view: change(view, head=90, display=XrayDisplay(270, False, False, WINDOW)),
    "turn": lambda view: change(view, display=XrayDisplay(90, True, False, WINDOW)),
    "show-again": lambda view: show_as(
        view, "/picture?again", display=XrayDisplay(0, False, True, Window(20000.0, 30000.0))
    ),
    "move": lambda view: change(view, points=[{**POINTS[0], "uv": (100.0, 500.0)}, *POINTS[1:]]),
    "short": lambda view: change(view, picture=replace(PICTURE, height=SIDE - 1)),
    "hostile": lambda view: change(view, points=[{**POINTS[0], "label": HOSTILE}, *POINTS[1:]]),
    "unknown-style": lambda view: draw(view, "odd", [{"shape": "line", "points": [[1, 2], [3, 4]], "style": "pink"}]),
    "acknowledge": lambda view: XrayView.acknowledge(view, next(one["seq"] for one in reversed(heard) if one["seq"])),
    "once-more": once_more,
}
"""What /do/NAME does to the PA view of every page."""


@app.get("/picture")
def _picture() -> Response:
    return Response(
        picture().tobytes(), media_type="application/octet-stream", headers={"Content-Encoding": "identity"}
    )


@app.get("/sight/{name}")
def _map(name: str) -> dict[str, Any]:
    return SIGHTS[name]


@app.get("/heard")
async def _heard() -> dict[str, Any]:  # in the loop of the events: what is counted and what is listed are of one moment
    return {"events": list(heard), "refused": sum(views["pa"].refused for views in pages)}


@app.post("/forget")
async def _forget(answering: bool) -> None:
    heard.clear()
    state["answering"] = answering


@app.post("/do/{name}")
async def _do(name: str, mark: int) -> None:
    for views in pages:
        COMMANDS[name](views["pa"])
    await asyncio.sleep(0)  # the calls of one moment are sent at its end; the mark comes after them
    for views in pages:
        views["pa"].client.run_javascript(f"window.marked = {mark}")


def main() -> None:
    port, seconds, revision = sys.argv[1:]
    state["revision"] = int(revision)
    ui.run(
        lambda: page(float(seconds)),
        host="127.0.0.1",
        port=int(port),
        reload=False,
        show=False,
        show_welcome_message=False,
        tailwind=False,
        dark=True,
    )


if __name__ == "__main__":
    main()
