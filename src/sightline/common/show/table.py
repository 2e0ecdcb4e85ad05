"""Results as tables of pandas, which Sightline does not need otherwise."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sightline.errors import UnusableInputError

if TYPE_CHECKING:
    from pandas import DataFrame


def dataframe(columns: Mapping[str, Any]) -> "DataFrame":
    """Return a DataFrame with these columns. Raises UnusableInputError where pandas is not installed."""
    try:
        from pandas import DataFrame
    except ImportError as error:
        raise UnusableInputError("to_dataframe() needs pandas: pip install pandas") from error
    return DataFrame(dict(columns))


def covariance_columns(covariance: Any, unit: str) -> dict[str, Any]:
    """Return the variances and the covariance of (N, 2, 2) matrices as columns: suu, suv and svv in `unit` squared."""
    pairs = {"suu": (0, 0), "suv": (0, 1), "svv": (1, 1)}
    return {f"{name}_{unit}2": covariance[:, i, j] for name, (i, j) in pairs.items()}
