"""Colours as people see them: contrast, and what is left of a difference without red or green cones.

Contrast and luminance: WCAG 2.2, 1.4.3 and its definitions. Dichromats: Machado, Oliveira, Fernandes, "A
physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15 (2009), severity 1. Distance: CIE
1976 L*a*b*, D65 (CIE 15:2004).
"""

import re

import numpy as np

TEXT, GRAPHIC = 4.5, 3.0  # WCAG 2.2, 1.4.3 (AA); 1.4.11, and 1.4.3 for large text
# Five times what is just seen side by side, 2.3 (Mahy, Van Eycken, Oosterlinck, Color Res. Appl. 19 (1994)): colours
# here are apart from each other [ours].
DISTINCT = 5 * 2.3
DICHROMATS = {
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def parsed(colour: str) -> tuple[np.ndarray, float]:
    """sRGB (3,), 0 to 1, and opacity, of `#rgb`, `#rrggbb` or `rgb(a)(...)`. Raises ValueError for anything else."""
    if found := re.fullmatch(r"#([0-9a-f]{3}|[0-9a-f]{6})", colour):
        digits = found[1] if len(found[1]) == 6 else "".join(2 * one for one in found[1])
        return np.array([int(digits[k : k + 2], 16) for k in (0, 2, 4)]) / 255, 1.0
    if found := re.fullmatch(r"rgba?\(([\d.]+),\s*([\d.]+),\s*([\d.]+)(?:,\s*([\d.]+))?\)", colour):
        return np.array([float(one) for one in found.groups()[:3]]) / 255, float(found[4] or 1.0)
    raise ValueError(f"no colour: {colour!r}")


def over(colour: str, *grounds: str) -> np.ndarray:
    """sRGB (3,) of a colour over others, the lowest, which is opaque, last."""
    rgb, opacity = parsed(colour)
    return rgb if not grounds else opacity * rgb + (1.0 - opacity) * over(*grounds)


def linear(rgb: np.ndarray) -> np.ndarray:
    """Light (3,) of sRGB (3,)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """1 to 21, of two sRGB (3,)."""
    low, high = sorted(float(_XYZ[1] @ linear(rgb)) for rgb in (one, other))
    return (high + 0.05) / (low + 0.05)


def distance(one: str, other: str, sight: np.ndarray) -> float:
    """Return the difference between two opaque colours for a person with the colour vision `sight` (3, 3)."""
    return float(np.linalg.norm(_lab(sight @ linear(over(one))) - _lab(sight @ linear(over(other)))))


def _lab(light: np.ndarray) -> np.ndarray:
    xyz = _XYZ @ np.clip(light, 0.0, 1.0) / _XYZ.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])
