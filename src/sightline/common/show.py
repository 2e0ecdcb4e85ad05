"""How a result shows itself: text at a prompt, a picture in a notebook, a plot, a table.

matplotlib is imported when something is drawn, pandas when a table is asked for.
"""

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from sightline.common.checks import Check, advised
from sightline.errors import UnusableInputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

__all__ = ["Plotted", "Shown", "dataframe"]

_DPI = 80
_MAX_PICTURE_BYTES = 500_000  # [ours] of the picture in a notebook: fifty of them stay below 35 MB
_SIDE_IN = 6.0
_LONGEST = 110  # characters of a line


class Shown:
    """A result with a short `repr`; a subclass gives `summary`, at most ten lines."""

    def summary(self) -> str:
        """Return what a person needs to know of the result, in at most ten lines."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.summary())}</pre>"


class Plotted(Shown):
    """A result with a picture as well; a subclass gives `_draw`, and `_new_axes` where one plain axes is not enough."""

    def plot(self, ax: Any = None) -> Any:
        """Draw the result and return the matplotlib axes; into `ax` where it is given, else into a new figure."""
        if ax is None:
            from matplotlib import pyplot

            ax = self._new_axes(pyplot.figure(figsize=self._size_in(), layout="constrained"))
        self._draw(ax)
        return ax

    def png(self, dpi: int = 2 * _DPI) -> bytes:
        """Return the picture that `plot` draws, as the bytes of a PNG file."""
        return _png(self._figure(), dpi)

    def _draw(self, ax: Any) -> None:
        raise NotImplementedError

    def _new_axes(self, figure: "Figure") -> Any:
        return figure.subplots()

    def _size_in(self) -> tuple[float, float]:
        return _SIDE_IN, _SIDE_IN

    def _repr_html_(self) -> str:
        return super()._repr_html_() + _picture(self._figure())

    def _figure(self) -> "Figure":
        """Return a figure that pyplot does not keep."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=self._size_in(), layout="constrained")
        self._draw(self._new_axes(figure))
        return figure


def _picture(figure: "Figure") -> str:
    """An HTML image with the figure as a PNG in it; smaller where it would be large."""
    dpi, png = 2 * _DPI, b""
    while not png or (len(png) > _MAX_PICTURE_BYTES and dpi > 10):
        dpi //= 2
        png = _png(figure, dpi)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _png(figure: "Figure", dpi: int) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def dataframe(columns: Mapping[str, Any]) -> "DataFrame":
    """Return a DataFrame with these columns. Raises UnusableInputError where pandas is not installed."""
    try:
        from pandas import DataFrame
    except ImportError as error:
        raise UnusableInputError("to_dataframe() needs pandas: pip install pandas") from error
    return DataFrame(dict(columns))


def covariance_columns(covariance_px2: Any) -> dict[str, Any]:
    """Return the variances and the covariance of (N, 2, 2) matrices as columns: suu, suv and svv, px²."""
    pairs = {"suu": (0, 0), "suv": (0, 1), "svv": (1, 1)}
    return {f"{name}_px2": covariance_px2[:, i, j] for name, (i, j) in pairs.items()}


def counted(count: int, name: str) -> str:
    """Return "1 bead" or "2 beads"."""
    return f"{count} {name}" if count == 1 else f"{count} {name}s"


def numbers(values: Iterable[float], digits: int) -> str:
    """Return "(1.0, 2.0, 3.0)"."""
    return f"({', '.join(f'{value:.{digits}f}' for value in values)})"


def image_size(shape: tuple[int, int] | None) -> str:
    """Return width x height, or that they are not known."""
    return "an image of unknown size" if shape is None else f"an image of {shape[1]} x {shape[0]} px"


def centre_sd(covariance_px2: np.ndarray | None) -> str:
    """Return the median standard deviation per axis of centres with the covariances (N, 2, 2)."""
    if covariance_px2 is None:
        return "error of the centres unknown"
    if not len(covariance_px2):
        return "no centres"
    return f"s.d. of a centre {np.sqrt(np.median(np.trace(covariance_px2, axis1=1, axis2=2)) / 2):.3f} px (median)"


def checks_lines(checks: Sequence[Check], most: int) -> list[str]:
    """Return how many checks passed, then the sentence of each that failed, `most` of them."""
    bad = advised(checks)
    counts = f"  checks: {len(checks) - len(bad)} of {len(checks)} passed"
    lines = [_cut(f"  failed: {check.name}: {check.sentence}") for check in bad[:most]]
    more = [f"  ... and {counted(len(bad) - most, 'failed check')} more"] if len(bad) > most else []
    return [counts, *lines, *more]


def _cut(line: str) -> str:
    return line if len(line) <= _LONGEST else line[: _LONGEST - 4] + " ..."
