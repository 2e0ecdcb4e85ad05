"""A case computed again from its originals, and each entry compared with what was recorded.

It may import `stages` and what lies below; it writes nothing into a case.
"""

from sightline.case.replay.compare_json import largest
from sightline.case.replay.outcomes import Outcome, Replayed, judge, replay
from sightline.case.replay.recompute import Recomputed

__all__ = ["Outcome", "Recomputed", "Replayed", "judge", "largest", "replay"]
