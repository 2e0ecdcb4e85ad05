"""The journal of a case: its folder, database, entries, hash chain and originals.

It records the content it is given and knows nothing of the stages that made it. It may import `canonical`, but nothing
else of `case`.
"""

from sightline.case.journal.case import Case
from sightline.case.journal.entry import Actor, Entry, Kind

__all__ = ["Actor", "Case", "Entry", "Kind"]
