"""Files of other people, read whole but never beyond a limit."""

from pathlib import Path

from sightline.errors import UnusableInputError


def read_bounded(file: Path, most_bytes: int, refuse: type[UnusableInputError], hint: str) -> bytes:
    """A whole file of at most `most_bytes`. Raises `refuse`, for one that is too large with the `hint` what to give."""
    try:
        with file.open("rb") as stream:
            data = stream.read(most_bytes + 1)  # a device has no size to ask for
    except OSError as error:
        raise refuse(f"cannot read {file.name}: {error.strerror}") from error
    if len(data) > most_bytes:
        size = f"{most_bytes >> 20} MiB" if most_bytes > 2**20 else f"{most_bytes >> 10} KiB"
        raise refuse(f"{file.name} is larger than {size}; {hint}")
    return data


def read_text(file: Path, most_bytes: int, refuse: type[UnusableInputError], hint: str) -> str:
    """The same as UTF-8. Raises `refuse`."""
    try:
        return read_bounded(file, most_bytes, refuse, hint).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise refuse(f"{file.name} is not a text file in UTF-8; {hint}") from error
