"""One line of the benchmark table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.stats import chi2

Result = TypeVar("Result")


@dataclass(frozen=True)
class Row:
    """A measured value next to the required one and to that of a peer in the same run.

    `met` is None where nothing is required: the value is for information.
    """

    group: str
    name: str
    value: str
    required: str = ""
    peer: str = ""
    met: bool | None = None


def finished(group: str, trials: "list[Result | str]") -> "tuple[list[Result], list[Row]]":
    """Return the results of trials, and the row that counts the refused ones; prints the reasons of those."""
    done = [trial for trial in trials if not isinstance(trial, str)]
    for reason in (trial for trial in trials if isinstance(trial, str)):
        print(f"refused: {reason}")
    return done, [Row(group, "set-ups refused", f"{len(trials) - len(done)} of {len(trials)}")]


def coverage_row(group: str, name: str, squares: Sequence[float], limits: Mapping[float, float], least: int = 0) -> Row:
    """Return the row of how many errors lie in their stated ellipsoids, of the volumes that `limits` names.

    `squares` (N,): squared Mahalanobis lengths of errors in space; `limits`: allowed difference from each stated share.
    With fewer than `least` errors nothing is shown to be met.
    """
    shares = {p: float(np.mean(np.asarray(squares) <= chi2.ppf(p, 3))) if len(squares) else np.nan for p in limits}
    return Row(
        group,
        f"{name}: {' / '.join(f'{100 * p:.0f}' for p in limits)} % ellipsoids cover",
        " / ".join(f"{100 * share:.1f}" for share in shares.values()) + f" % of {len(squares)}",
        "± " + " / ".join(f"{100 * limit:.1f}" for limit in limits.values()) + " %",
        "" if len(squares) >= least else f"fewer than {least}",
        len(squares) >= least and all(abs(shares[p] - p) <= limit for p, limit in limits.items()),
    )
