"""Strict reading of what people write: unknown names, and unknown and repeated keys of JSON, are refused."""

import json
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sightline.errors import RefusedError, UnusableInputError

_ERRORS_SHOWN = 3
_SHOWN = 200  # characters of an error of the JSON
_Model = TypeVar("_Model", bound=BaseModel)


def read_strictly(
    text: bytes | str, model: type[_Model], refuse: type[UnusableInputError], advice: Mapping[str, str]
) -> _Model:
    """Return the document in a JSON text. Raises `refuse` with sentences.

    `advice`: what to do about pydantic's kinds of errors, by their names.
    """

    strict_json(text, refuse, advice["finite_number"].partition("; ")[2])
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise refuse(explain(error, advice)) from None


def strict_json(text: bytes | str, refuse: type[UnusableInputError], otherwise: str) -> Any:
    """Return the value of a JSON text without repeated keys, NaN and infinities. Raises `refuse` with sentences.

    `otherwise`: what to do about what is no number.
    """

    def without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise refuse(f"the key {twice[0]!r} occurs twice in one object; remove one")
        return dict(pairs)

    def no_constant(name: str) -> float:
        raise refuse(f"{name} is not a number; {otherwise}")

    try:
        return json.loads(text, object_pairs_hook=without_repeats, parse_constant=no_constant)
    except (ValueError, RecursionError) as error:
        raise refuse(f"the file is not JSON: {str(error)[:_SHOWN]}") from None


@contextmanager
def naming(file: Path, advice: str = "") -> Generator[None]:
    """Context in which refusals, and pydantic's errors with `advice`, become UnusableInputErrors that name the file."""
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise UnusableInputError(f"{file.name}: {where}: {first['msg']}; {advice}") from None
    except (UnusableInputError, RefusedError) as error:
        raise UnusableInputError(f"{file.name}: {error}") from None


def explain(error: ValidationError, advice: Mapping[str, str]) -> str:
    """Return pydantic's errors as sentences that say where each is and what to do."""
    errors = error.errors(include_url=False, include_context=True)
    shown = [_explain_one(entry["type"], entry["loc"], entry["msg"], advice) for entry in errors[:_ERRORS_SHOWN]]
    more = len(errors) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _explain_one(kind: str, where: tuple[int | str, ...], message: str, advice: Mapping[str, str]) -> str:
    place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in where).lstrip(".")
    reason = advice.get(kind, message.removeprefix("Value error, "))
    return f"{place} {reason}" if place else reason
