"""Finished trials on disk, one line each, so that an interrupted run loses no finished trial.

The first line identifies the study; every other line is `{"trial": 17, "values": {...}}`, in the order in which trials
finished. An incomplete last line (power cut, full disk) is removed when the file is opened again. The values of a trial
follow from header and number alone, so a duplicate does no harm.
"""

import json
import os
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import sightline
from sightline.errors import UnusableInputError
from sightline.studies.runs.study import Study, Values

TRIALS = "trials.jsonl"


@cache
def code_digest() -> str:
    """Return the digest of the package's source as this process found it, without parts that no trial uses. During
    development, equal versions may have different code."""
    root = Path(sightline.__file__).parent
    digest = sha256()
    for file in sorted(root.rglob("*.py")):
        if file.relative_to(root).parts[0] not in ("cli", "app"):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def header(study: Study, seed: int) -> dict[str, Any]:
    """Return everything that determines the values of a trial, besides its number."""
    return {
        "study": study.name,
        "version": sightline.__version__,
        "code": code_digest(),
        "seed": seed,
        "configuration": study.configuration,
    }


@dataclass(frozen=True)
class Record:
    """The file of one study, and its `finished` trials: values by number."""

    file: Path
    finished: dict[int, Values]

    @staticmethod
    def open(folder: Path, expected: dict[str, Any]) -> "Record":
        """Open the record of a folder, or create it.

        Raises UnusableInputError if it cannot be written, or holds trials of anything else than `expected`.
        """
        file = folder / TRIALS
        try:
            folder.mkdir(parents=True, exist_ok=True)
            text = file.read_bytes() if file.exists() else b""
            whole = text[: text.rfind(b"\n") + 1]
            if len(whole) < len(text):
                os.truncate(file, len(whole))
        except OSError as error:
            raise _unusable(file, error) from error
        record = Record(file, {})
        if not whole:
            record._append([expected])
            return record
        try:
            found, *lines = [json.loads(line) for line in whole.splitlines()]
            record.finished.update({line["trial"]: line["values"] for line in lines})
        except (ValueError, KeyError, TypeError):
            raise UnusableInputError(
                f"{file} is not a record of trials; delete it, or name another folder with --out"
            ) from None
        _refuse_other(found, json.loads(json.dumps(expected)), file)
        return record

    def add(self, values: dict[int, Values]) -> None:
        """Record finished trials; they are on the disk when this returns. Raises UnusableInputError."""
        self._append([{"trial": trial, "values": each} for trial, each in values.items()])
        self.finished.update(values)

    def _append(self, lines: list[dict[str, Any]]) -> None:
        text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines)
        try:
            with self.file.open("ab") as out:
                out.write(text.encode())
                out.flush()
                os.fsync(out.fileno())
        except OSError as error:
            raise _unusable(self.file, error) from error


def _unusable(file: Path, error: OSError) -> UnusableInputError:
    return UnusableInputError(
        f"cannot write {file}: {error.strerror}; finished trials are kept: make room, or name another folder with "
        "--out, and run the command again"
    )


def _refuse_other(found: Any, expected: dict[str, Any], file: Path) -> None:
    """Refuse a record of another study, seed, configuration or code: their trials must not be mixed."""
    if found == expected:
        return
    found = found if isinstance(found, dict) else {}
    names = [name for name in expected if found.get(name) != expected[name]]
    details = "; ".join(
        f"{name} {found.get(name)!r} there, {expected[name]!r} now"
        if name != "configuration"
        else _difference(found.get(name), expected[name])
        for name in names
    )
    raise UnusableInputError(
        f"{file} holds trials that these must not be mixed with ({details}); delete it, or name another folder with "
        "--out"
    )


def _difference(there: Any, now: dict[str, Any]) -> str:
    there = there if isinstance(there, dict) else {}
    differ = sorted(name for name in {*there, *now} if there.get(name) != now.get(name))
    return f"another configuration: {', '.join(differ)}"
