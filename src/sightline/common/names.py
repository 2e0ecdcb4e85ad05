"""Values that people choose by name. Apart from `strict`, whose pydantic a view of an array does not need."""

from collections.abc import Mapping
from typing import TypeVar

from sightline.errors import SightlineError, UnusableInputError

_Value = TypeVar("_Value")


def named(
    name: str, known: Mapping[str, _Value], what: str, refuse: type[SightlineError] = UnusableInputError
) -> _Value:
    """Return the value that has a name. `what`: the kind of value. Raises `refuse`, which lists the names."""
    if name not in known:
        raise refuse(f"there is no {what} {name!r}; there are: {', '.join(known)}")
    return known[name]
