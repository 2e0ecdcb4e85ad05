"""What a result says at a prompt and shows in a notebook. matplotlib is imported when something is drawn."""

import base64
import io
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 80
_MAX_PICTURE_BYTES = 500_000  # [ours] of the picture in a notebook: fifty of them stay below 35 MB
_SIDE_IN = 6.0


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
