"""Read frame files (docs/frame-file.md) with strict checks."""

import csv
from pathlib import Path

from pydantic import ValidationError

from sightline.common.bounded import read_bounded, read_text
from sightline.common.strict import explain, read_strictly
from sightline.errors import FrameError
from sightline.frame.document import FrameDocument
from sightline.frame.solids import FRAME_NAMES
from sightline.frame.xmalab import DIAMETER_MM, cube_document

SIZE_LIMIT_BYTES = 64 * 2**20  # [ours] six times the full covariance of the built-in frames
ADVICE = {
    "extra_forbidden": "is not a key of the frame file; correct its spelling or remove it",
    "missing": "is missing; add it",
    "finite_number": "is not a finite number; leave out the ball if it could not be measured",
    "float_type": "is not a number; write it without quotes",
    "too_short": "has too few entries; a plate needs four fiducials, a position three numbers, a frame one view",
    "too_long": "has too many entries; a position is three numbers",
    "string_pattern_mismatch": "must be 1 to 64 letters, digits or any of _ . : + / -",
}


def read_document(path: Path) -> FrameDocument:
    """Return the document in a frame file, or in a frame specification of XMALab (CSV). Raises FrameError."""
    if not path.is_file():
        raise FrameError(
            f"there is no frame file {path.name!r}; give a file, or one of the built-in frames: "
            f"{', '.join(FRAME_NAMES)}"
        )
    if path.suffix.lower() == ".csv":
        return read_cube(path)
    data = read_bounded(path, SIZE_LIMIT_BYTES, FrameError, "give a frame file")
    try:
        return document_from_json(data)
    except FrameError as error:
        raise FrameError(f"{path.name}: {error}") from None


def read_cube(path: Path, diameter_mm: float = DIAMETER_MM, unit: str | None = None) -> FrameDocument:
    """Return the document of a frame specification of XMALab, whose balls have one diameter. Raises FrameError.

    `unit`: mm or cm; None: by the size of the object.
    """
    text = read_text(path, SIZE_LIMIT_BYTES, FrameError, "give a frame specification of XMALab")
    try:
        return FrameDocument.model_validate(cube_document(text, path.stem, diameter_mm, unit))
    except ValidationError as error:
        raise FrameError(f"{path.name}: {explain(error, ADVICE)}") from None
    except (FrameError, csv.Error) as error:
        raise FrameError(f"{path.name}: {error}") from None


def document_from_json(text: bytes) -> FrameDocument:
    """Return the document in the text of a frame file. Raises FrameError."""
    return read_strictly(text, FrameDocument, FrameError, ADVICE)
