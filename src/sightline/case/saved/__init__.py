"""Results as JSON files, and back: what `save` writes, `load` reads.

A file names its form in "schema" and carries a digest: one that was edited is refused. Views, plans and trajectories
have the keys that the command line writes, and what they were made from besides. A view or a plan is computed again
from that when it is read, which takes hundredths of a second, and is refused where the result differs from the file's.
"""

from sightline.case.saved.files import document, load, save

__all__ = ["document", "load", "save"]
