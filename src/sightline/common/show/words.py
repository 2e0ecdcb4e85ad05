"""Words and numbers of summaries."""

from collections.abc import Iterable, Sequence

import numpy as np

from sightline.common.checks import Check, failed

_LONGEST = 110  # characters of a line


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
    bad = failed(checks)
    said = f"  checks: {len(checks) - len(bad)} of {len(checks)} passed"
    lines = [_cut(f"  failed: {check.name}: {check.sentence}") for check in bad[:most]]
    more = [f"  ... and {counted(len(bad) - most, 'failed check')} more"] if len(bad) > most else []
    return [said, *lines, *more]


def _cut(line: str) -> str:
    return line if len(line) <= _LONGEST else line[: _LONGEST - 4] + " ..."
