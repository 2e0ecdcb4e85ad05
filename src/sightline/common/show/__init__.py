"""How a result shows itself: text at a prompt, a picture in a notebook, a plot, a table."""

from sightline.common.show.face import Plotted, Shown
from sightline.common.show.table import dataframe

__all__ = ["Plotted", "Shown", "dataframe"]
