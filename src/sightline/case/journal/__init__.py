"""The journal of a case: its folder, database, entries, chain of hashes and originals.

It keeps what it is given and does not know what a stage computes. It may import `canonical`, but nothing else of
`case`.
"""

from sightline.case.journal.case import Case
from sightline.case.journal.entry import Actor, Entry, Kind

__all__ = ["Actor", "Case", "Entry", "Kind"]
