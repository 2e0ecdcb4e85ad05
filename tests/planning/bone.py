"""A right femur of known form, and what a person would draw of it on two stand-in views."""

from functools import cache

import numpy as np
from scipy.optimize import brentq

from sightline.planning import Aids, Circle, Line, MatchingCurve, Pick, matching_curve

from .standin import StandInView, pair

CENTRE_MM, RADIUS_MM = np.array([-11.3, -17.6, 6.2]), 23.7
SHAFT = np.array([0.08, 0.99, -0.06]) / np.linalg.norm([0.08, 0.99, -0.06])  # caudal: +Y of a right hip
ON_SHAFT_MM = np.array([27.9, 12.4, -5.1])
ENTRY_MM, END_MM = np.array([40.5, 34.1, -6.0]), np.array([-20.1, -27.4, 8.8])
LESSER_MM = ENTRY_MM + np.array([-35.3, 4.7, -8.2])
VERSION_RAD, NECK_SHAFT_RAD = np.deg2rad(11.5), np.deg2rad(127.2)
FORWARD = np.array([0.0, 0.0, 1.0]) - SHAFT[2] * SHAFT
FORWARD /= np.linalg.norm(FORWARD)
INWARD = np.cross(FORWARD, SHAFT)
INWARD *= -np.sign(INWARD[0])
ACROSS = np.cos(VERSION_RAD) * INWARD + np.sin(VERSION_RAD) * FORWARD
NECK = np.cos(NECK_SHAFT_RAD) * SHAFT + np.sin(NECK_SHAFT_RAD) * ACROSS
ON_NECK_MM = CENTRE_MM - 38.0 * NECK + np.array([0.4, -0.3, 0.5])  # its axis need not meet the head's centre


@cache
def views() -> list[StandInView]:
    """PA and lateral stand-in view."""
    return pair(0.05)


@cache
def curve_once() -> MatchingCurve:
    """One matching curve, for plans whose curves do not matter."""
    return matching_curve(views()[0], np.array([512.0, 512.0]), views()[1])


def rim(view: StandInView, turns_rad: np.ndarray) -> np.ndarray:
    """(M, 2) pixels whose lines of sight touch the head, in these directions from its centre's image: by bisection."""
    middle = view.project(CENTRE_MM[None])[0]

    def outside_mm(radius_px: float, turn: float) -> float:
        pixel = middle + radius_px * np.array([np.cos(turn), np.sin(turn)])
        ray = view.plane.to_space(view.to_plane(pixel[None]))[0] - view.focal_point_mm
        return float(np.linalg.norm(np.cross(CENTRE_MM - view.focal_point_mm, ray)) / np.linalg.norm(ray) - RADIUS_MM)

    return np.array(
        [
            middle + brentq(outside_mm, 20.0, 400.0, args=(turn,)) * np.array([np.cos(turn), np.sin(turn)])
            for turn in turns_rad
        ]
    )


def drawn_line(view: StandInView, on_mm: np.ndarray, along: np.ndarray, places_mm: tuple[float, float]) -> np.ndarray:
    """(2, 2) pixels of an axis; other places in each view, since clicks need not correspond."""
    return view.project(on_mm + np.array(places_mm)[:, None] * along)


def calcar_mm() -> np.ndarray:
    """A point 13 mm caudal of the neck's axis, as the PA view shows the medial cortex."""
    below = SHAFT - (SHAFT @ NECK) * NECK
    return CENTRE_MM - 30.0 * NECK + 13.0 * below / np.linalg.norm(below)


def cortex_mm(view: StandInView, radius_mm: float = 14.8) -> np.ndarray:
    """Where a line of sight of the view touches the lateral cortex, a cylinder about the shaft's axis."""
    at = ON_SHAFT_MM + 20.0 * SHAFT
    ray = at - view.focal_point_mm
    sideways = np.cross(ray, SHAFT)
    sideways /= np.linalg.norm(sideways)
    return at + radius_mm * sideways * np.sign(sideways[0])


def pixels(views: list[StandInView]) -> dict[str, list[np.ndarray]]:
    """Everything that is drawn, without error, for each view."""
    turns = [np.deg2rad([100.0, 160.0, 220.0, 290.0, 340.0]), np.deg2rad([20.0, 110.0, 200.0, 280.0])]
    return {
        "head": [rim(view, turn) for view, turn in zip(views, turns, strict=True)],
        "neck": [drawn_line(v, ON_NECK_MM, NECK, p) for v, p in zip(views, ((-4.0, 21.0), (2.0, 25.0)), strict=True)],
        "shaft": [
            drawn_line(v, ON_SHAFT_MM, SHAFT, p) for v, p in zip(views, ((5.0, 44.0), (-9.0, 38.0)), strict=True)
        ],
        "calcar": [views[0].project(calcar_mm()[None])[0]],
        "cortex": [views[0].project(cortex_mm(views[0])[None])[0]],
        "wire": [view.project(np.stack([ENTRY_MM, END_MM])) for view in views],
    }


def aids(uv_px: dict[str, list[np.ndarray]], sd_px: float = 0.5) -> Aids:
    """As drawn at these pixels."""
    head, neck, shaft = (uv_px[name] for name in ("head", "neck", "shaft"))
    return Aids(
        head=(Circle.through(head[0], sd_px), Circle.through(head[1], sd_px)),
        neck=(Line(neck[0], sd_px), Line(neck[1], sd_px)),
        shaft=(Line(shaft[0], sd_px), Line(shaft[1], sd_px)),
        calcar=Pick.free(uv_px["calcar"][0], sd_px),
        cortex=Pick.free(uv_px["cortex"][0], sd_px),
    )


def picks(uv_px: dict[str, list[np.ndarray]], sd_px: float = 0.5) -> tuple[tuple[Pick, Pick], ...]:
    """Entry and end, free in both views."""
    return tuple(
        (Pick.free(a, sd_px), Pick.free(b, sd_px)) for a, b in zip(uv_px["wire"][0], uv_px["wire"][1], strict=True)
    )
