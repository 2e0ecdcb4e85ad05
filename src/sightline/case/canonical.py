"""Canonical JSON: equal values have equal bytes, and so equal hashes, on every machine."""

from dataclasses import fields, is_dataclass
from hashlib import sha256
from json import dumps
from math import isnan
from typing import Any

from sightline.errors import CaseError


def canonical(value: Any) -> str:
    """Return plain values, arrays and dataclasses as JSON: sorted keys, no spaces, each float as the shortest text that
    reads back to the same bits. Raises CaseError for values that JSON cannot hold and for numbers that are not finite.
    """
    try:
        return dumps(plain(value), allow_nan=False, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise CaseError(
            f"a case holds JSON: {error}; use None for unknown values, and lists and numbers for the rest"
        ) from None


def digest(data: str | bytes) -> str:
    """Return the SHA-256 in hexadecimal; text is encoded as UTF-8."""
    return sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def plain(value: Any) -> Any:
    """Return dataclasses, arrays and tuples as dicts and lists; other values are returned unchanged."""
    if is_dataclass(value) and not isinstance(value, type):
        written = (field for field in fields(value) if field.metadata.get("written", True))
        return {field.name: plain(getattr(value, field.name)) for field in written}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    to_list = getattr(value, "tolist", None)  # numpy arrays and scalars have it
    return value if to_list is None else to_list()


def with_null(value: Any) -> Any:
    """Return `plain(value)` with None for NaN, as of a pick in an image that does not show the point."""
    value = plain(value)
    if isinstance(value, dict):
        return {name: with_null(item) for name, item in value.items()}
    if isinstance(value, list):
        return [with_null(item) for item in value]
    return None if isinstance(value, float) and isnan(value) else value
