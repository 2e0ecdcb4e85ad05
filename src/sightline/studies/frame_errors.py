"""Errors of a wire's ends with one frame: of a trial, over all trials, and in a table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import sightline as sl
from sightline.calibration.view import CalibratedView
from sightline.studies.figure_spans import Span
from sightline.studies.intervals import rms, share
from sightline.studies.study import Estimate, EstimateGroup, Table, Values

PICK_PX = 0.1  # a located target (physics.md, Picks)
BEAD_PX = 0.1  # physics.md, Centroid limit
INTERVAL = "rms (tick) with its 95 % interval (bar)"


def located(views: Sequence[CalibratedView], uv_px: np.ndarray, true_mm: np.ndarray) -> Values:
    """Return the errors of points (N, 3) picked in views (V, N, 2), and the roots of their stated variances, mm.

    Raises SightlineError.
    """
    points = sl.reconstruct(views, uv_px, np.broadcast_to(PICK_PX**2 * np.eye(2), (*uv_px.shape, 2)))
    stated = np.sqrt(np.trace(points.covariance_mm2, axis1=1, axis2=2))
    return {"error": np.linalg.norm(points.xyz_mm - true_mm, axis=1).round(6).tolist(), "stated": stated.tolist()}


@dataclass(frozen=True)
class DesignResult(EstimateGroup):
    """The result of one design: `error` and `stated`, mm rms; how often it was `refused`."""

    error: Estimate
    stated: Estimate
    refused: Estimate

    @staticmethod
    def of(key: str, trials: Sequence[Values]) -> "DesignResult":
        """Return the result over all trials."""
        kept = [trial[key] for trial in trials if trial[key] is not None]
        return DesignResult(
            rms(f"{key}: error", [np.array(one["error"]) for one in kept], "mm"),
            rms(f"{key}: stated", [np.array(one["stated"]) for one in kept], "mm"),
            share(f"{key}: refused", np.array([trial[key] is None for trial in trials])),
        )

    def span(self, name: str, colour: str = "beads") -> Span:
        """Return the row of the picture: the error with its interval; marked is the stated error."""
        value = self.error.value or 0.0
        return Span(name, self.error.low or value, value, self.error.high or value, self.stated.value, colour)

    @property
    def cell(self) -> str:
        """The table cell: error / stated."""
        if self.error.value is None:
            return "refused"
        refused = f", {self.refused.value:.0%} refused" if self.refused.value else ""
        return f"{self.error.value:.3f} / {self.stated.value:.3f}{refused}"


def error_table(title: str, keys: Sequence[str], found: dict[str, DesignResult]) -> Table:
    """Return the table of some results by name."""
    rows = tuple((key, found[key].cell, str(found[key].error)) for key in keys)
    return Table(title, ("", "error / stated, mm rms", "95 % interval of the error"), rows)
