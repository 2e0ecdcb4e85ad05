"""Recompute a case from its originals and compare each result with its entry.

It may import `stages` and what lies below; it writes nothing into a case.
"""

from sightline.case.replay.compare import largest
from sightline.case.replay.outcomes import Replayed, ReplayOutcome, judge, replay
from sightline.case.replay.recompute import Recomputed

__all__ = ["Recomputed", "ReplayOutcome", "Replayed", "judge", "largest", "replay"]
