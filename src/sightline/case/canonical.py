"""One text for one value: JSON whose bytes, and so whose hash, are the same wherever the value is."""

from dataclasses import fields, is_dataclass
from hashlib import sha256
from json import dumps
from typing import Any

from sightline.errors import CaseError


def canonical(value: Any) -> str:
    """JSON of plain values, arrays and dataclasses: keys in order, no spaces, floats as the shortest text that reads
    back to the same bits. Raises CaseError on what is no JSON and on numbers that are not finite."""
    try:
        return dumps(plain(value), allow_nan=False, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise CaseError(
            f"a case holds JSON: {error}; write None for what is unknown, and lists and numbers for the rest"
        ) from None


def digest(data: str | bytes) -> str:
    """SHA-256 in hexadecimal."""
    return sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def plain(value: Any) -> Any:
    """Dataclasses, arrays and tuples as dicts and lists; what else there is stays."""
    if is_dataclass(value) and not isinstance(value, type):
        written = (field for field in fields(value) if field.metadata.get("written", True))
        return {field.name: plain(getattr(value, field.name)) for field in written}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    to_list = getattr(value, "tolist", None)  # of numpy arrays and scalars
    return value if to_list is None else to_list()
