"""Conversion of entries to rows of the journal, and back."""

import json
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sightline.case.canonical import digest
from sightline.case.journal.entry import Actor, Entry, Kind
from sightline.errors import CaseError

# Columns that the hash chain covers, in the order of the table; `content` and `chain` follow them.
HEAD = ("number", "kind", "at", "by", "versions", "settings", "rests_on", "content_sha256")


def first_link(case_number: str) -> str:
    """Return the first hash of the chain."""
    return digest(f"sightline case {case_number}")


def head_of_row(row: Sequence[Any]) -> dict[str, Any]:
    """Return the columns of HEAD by name, with their texts as the database stores them."""
    return dict(zip(HEAD, row[: len(HEAD)], strict=True))


def entry_of_row(row: Sequence[Any]) -> Entry:
    """Return a row as an entry. Raises CaseError if the row is damaged."""
    number, kind, at, by, versions, settings, rests_on, content_sha256, content, chain = row
    try:
        return Entry(
            number=number,
            kind=Kind(kind),
            at=datetime.fromisoformat(at),
            by=Actor(by),
            versions=json.loads(versions),
            settings=json.loads(settings),
            content=json.loads(content),
            rests_on=tuple(json.loads(rests_on)),
            content_sha256=content_sha256,
            chain=chain,
        )
    except (TypeError, ValueError):
        raise CaseError(f"entry {number} of the case is damaged; run `sightline case check` for details") from None
