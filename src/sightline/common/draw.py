"""What plots of results are drawn with, on matplotlib axes: images with marks, arrows, points in space."""

from collections.abc import Sequence
from typing import Any

import numpy as np

BLUE, ORANGE, RED, GREEN = (
    "#56b4e9",
    "#ffb000",
    "#ff3b30",
    "#2bd19a",
)  # visible on grey, distinguishable with colour-vision deficiency
_ARROW_PX = 0.06  # of the image's width: length that the 95 % quantile of arrows is drawn with
_ELLIPSOID = 0.08  # of the points' extent: size that an error ellipsoid is drawn with
_STEPS = np.array([1.0, 2.0, 5.0])


def image(ax: Any, pixels: np.ndarray | None, shape: tuple[int, int] | None, uv_px: np.ndarray, title: str) -> None:
    """Draw the image, or its empty field where there are no pixels, with the axes of IDCS: v points down.

    Where the shape is not known either, the field is that of the points `uv_px` (N, 2).
    """
    if pixels is not None:
        some = pixels[::4, ::4]
        low, high = some.min(), np.percentile(some, 98.0)
        ax.imshow(pixels, cmap="gray", vmin=low, vmax=max(high, low + 1e-6))
        shape = pixels.shape[0], pixels.shape[1]
    else:
        ax.set_facecolor("0.35")
    low, high = (np.zeros(2), np.array(shape[::-1]) - 1.0) if shape else _around(uv_px)
    ax.set(xlim=(low[0] - 0.5, high[0] + 0.5), ylim=(high[1] + 0.5, low[1] - 0.5), aspect="equal")
    ax.set(xlabel="u, px", ylabel="v, px", title=title)


def _around(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a box around points (N, D), wider than they by a tenth to each side."""
    if not len(points):
        return np.zeros(points.shape[-1]), np.ones(points.shape[-1])
    low, high = points.min(axis=0), points.max(axis=0)
    spare = 0.1 * max(float((high - low).max()), 1.0)
    return low - spare, high + spare


def circles(ax: Any, uv_px: np.ndarray, radius_px: np.ndarray, colour: str, name: str) -> None:
    """Draw circles of the image's own size; none where there are no points."""
    from matplotlib.collections import EllipseCollection

    if len(uv_px):
        size, place = 2.0 * radius_px, {"offsets": uv_px, "offset_transform": ax.transData}
        look = {"facecolors": "none", "edgecolors": colour, "linewidths": 1.2}
        ax.add_collection(EllipseCollection(size, size, np.zeros(len(size)), units="xy", **place, **look))
        ax.plot([], [], "o", color="none", markeredgecolor=colour, label=f"{name} ({len(uv_px)})")


def labels(ax: Any, uv_px: np.ndarray, radius_px: np.ndarray, names: Sequence[str], colour: str) -> None:
    """Draw circles, small ones where a radius is not known, and beside each its name."""
    circles(ax, uv_px, np.nan_to_num(radius_px, nan=4.0), colour, "labelled")
    for (u, v), radius, name in zip(uv_px, np.nan_to_num(radius_px, nan=4.0), names, strict=True):
        ax.annotate(name, (u + radius, v - radius), color=colour, fontsize=5, clip_on=True, annotation_clip=True)


def marks(ax: Any, uv_px: np.ndarray, marker: str, colour: str, name: str) -> None:
    """Draw markers; none where there are no points."""
    if len(uv_px):
        ax.plot(*np.transpose(uv_px), marker, color=colour, markerfacecolor="none", label=name, linestyle="none")


def legend(ax: Any) -> None:
    """Name what is drawn, below the axes, where nothing is covered."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4, fontsize="small", frameon=False)


def arrows(ax: Any, uv_px: np.ndarray, arrows_px: np.ndarray, mm_px: float, colour: str) -> float:
    """Draw arrows (N, 2), px, at pixels (N, 2), magnified, with a key; return the magnification.

    `mm_px`: millimetres that a pixel stands for, for the key.
    """
    lengths = np.linalg.norm(arrows_px, axis=1)
    width = abs(ax.get_xlim()[1] - ax.get_xlim()[0])
    longest = max(float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0, 1e-9)
    times = max(round_down(_ARROW_PX * width / longest), 1.0)
    scaled = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / times}
    arrow = ax.quiver(*uv_px.T, *arrows_px.T, color=colour, width=0.004, **scaled)
    key_mm = round_down(2.0 * longest * mm_px)
    ax.quiverkey(arrow, 0.84, 1.03, key_mm / mm_px, f"{key_mm:g} mm", labelpos="E", color="black", angle=0)
    return times


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * _STEPS[_STEPS * power <= value * (1 + 1e-9)][-1])


def space(ax: Any, xyz_mm: np.ndarray, bounds_mm2: np.ndarray | None, names: Sequence[str], title: str) -> None:
    """Draw points (N, 3), CFCS, on axes of three dimensions, with their 95 % error ellipsoids, magnified.

    `bounds_mm2` (N, 3, 3): x' inv(B) x = 1 on the ellipsoid; None where the error is unknown.
    """
    ax.scatter(*xyz_mm.T, color="#0072b2", depthshade=False)
    for name, point in zip(names, xyz_mm, strict=True):
        ax.text(*point, f"  {name}")
    low, high = _around(xyz_mm)
    if bounds_mm2 is not None and len(xyz_mm):
        size = float(np.sqrt(np.linalg.eigvalsh(bounds_mm2).max()))
        times = max(round_down(_ELLIPSOID * float((high - low).max()) / max(size, 1e-9)), 1.0)
        for point, bound in zip(xyz_mm, bounds_mm2, strict=True):
            ax.plot_wireframe(*_ellipsoid(point, times**2 * bound), color="#d55e00", alpha=0.5, linewidth=0.6)
        title += f"\n95 % error ellipsoids, {times:g} times as large"
    box(ax, xyz_mm, title)


def box(ax: Any, xyz_mm: np.ndarray, title: str) -> None:
    """Give axes of three dimensions the same scale along each, with points (N, 3), mm, inside."""
    low, high = _around(xyz_mm)
    middle, half = (low + high) / 2, float((high - low).max()) / 2
    sides = np.stack([middle - half, middle + half], axis=1)
    ax.set(xlim=sides[0], ylim=sides[1], zlim=sides[2], xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", title=title)
    ax.set_box_aspect((1, 1, 1))


def _ellipsoid(middle: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """(3, 13, 9) points of the surface x' inv(bound) x = 1 about `middle`."""
    around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 13), np.linspace(0, np.pi, 9), indexing="ij")
    unit = np.stack([np.cos(around) * np.sin(up), np.sin(around) * np.sin(up), np.cos(up)])
    values, vectors = np.linalg.eigh(bound)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return middle[:, None, None] + np.einsum("ij,jkl->ikl", root, unit)
