"""SVG markup: figures that use the page's own colours, light or dark, and need no other file."""

from collections.abc import Iterable
from html import escape

import numpy as np


def number(value: float) -> str:
    """Format a coordinate with at most two decimals and no trailing zeros."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def points(xy: np.ndarray) -> str:
    """Format points (N, 2) as an attribute: "x,y x,y"."""
    return " ".join(f"{number(x)},{number(y)}" for x, y in np.asarray(xy))


def element(tag: str, *content: str, **attributes: object) -> str:
    """Return one element. In attribute names underscores become hyphens, and `class_` becomes class; floats are
    shortened."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(number(value) if isinstance(value, float) else str(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return f"<{tag}{written}>{''.join(content)}</{tag}>" if content else f"<{tag}{written}/>"


def hint(text: str) -> str:
    """Return a hint that is shown while the pointer rests on the element."""
    return f"<title>{escape(text)}</title>"


def text(content: str, x: float, y: float, **attributes: object) -> str:
    """Return a line of text."""
    return element("text", escape(content), x=float(x), y=float(y), **attributes)


def group(parts: Iterable[str], **attributes: object) -> str:
    """Return a group of parts that are styled together."""
    return element("g", *parts, **attributes)


def figure(
    view_box: tuple[float, float, float, float], description: str, parts: Iterable[str], **attributes: object
) -> str:
    """Return a whole figure; screen readers read its `description`."""
    box = " ".join(number(v) for v in view_box)
    return element(
        "svg", *parts, xmlns="http://www.w3.org/2000/svg", viewBox=box, role="img", aria_label=description, **attributes
    )
