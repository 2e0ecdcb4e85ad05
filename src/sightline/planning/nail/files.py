"""Files of nails, as their makers state them: those that are shipped, those in a folder of the user's, and others by
their path."""

from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from sightline.common.bounded import MAX_TEXT_BYTES, read_bounded
from sightline.common.strict import read_strictly
from sightline.errors import UnusableInputError
from sightline.planning.nail.result import Nail
from sightline.planning.procedures.document import Strict
from sightline.planning.procedures.procedure import ADVICE, user_files

NAILS_FOLDER = "SIGHTLINE_NAILS"  # environment variable: the folder of the user's files
_ADVICE = {**ADVICE, "extra_forbidden": "is not a key of a nail's file; correct its spelling or remove it"}


class NailFile(Strict):
    """A nail's file: its name, and `Nail`'s sizes, mm."""

    schema_: Annotated[Literal["sightline-nail/1"], Field(alias="schema")]
    name: Annotated[str, Field(min_length=1, max_length=60)]
    diameter_mm: float
    hole_mm: float
    bore_mm: float
    material: str
    spacing_mm: float | None = None
    source: Annotated[str, Field(max_length=200)] = ""

    @property
    def nail(self) -> Nail:
        """The nail. Raises UnusableInputError."""
        return Nail(**self.model_dump(exclude={"schema_", "name", "source"}))


@cache
def shipped_nails() -> dict[str, NailFile]:
    """Return the shipped files by key."""
    folder = files("sightline.planning.nail") / "shipped"
    texts = sorted((file.name.removesuffix(".json"), file.read_bytes()) for file in folder.iterdir())
    return {key: read_strictly(text, NailFile, UnusableInputError, _ADVICE) for key, text in texts}


def known_nails() -> dict[str, NailFile]:
    """Return the shipped files and those in the user's folder, by key; a shipped key takes precedence.

    Raises UnusableInputError.
    """
    own = {key: _read(path) for key, path in user_files(NAILS_FOLDER).items()}
    return {**own, **shipped_nails()}


def nail_of(name: str) -> Nail | None:
    """Return the nail of a key or of a file's path; None for another text. Raises UnusableInputError."""
    known = known_nails()
    if name in known:
        return known[name].nail
    return _read(Path(name)).nail if name.endswith(".json") else None


def _read(path: Path) -> NailFile:
    try:
        text = read_bounded(path, MAX_TEXT_BYTES, UnusableInputError, "give a nail's file")
        made = read_strictly(text, NailFile, UnusableInputError, _ADVICE)
        _ = made.nail  # its sizes fit each other
    except UnusableInputError as error:
        raise UnusableInputError(f"{path.name}: {error}") from None
    return made
