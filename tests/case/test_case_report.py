"""What a report tells of a case besides its plan."""

from pathlib import Path

import pytest

from sightline.case.journal import Actor, Case, Kind
from sightline.case.replay import Recomputed
from sightline.case.report import content as case_report


def test_a_check_shot_of_an_earlier_version_is_left_out(tmp_path: Path) -> None:
    """It did not say what it was measured from, so nobody can measure it again."""
    with Case.create(tmp_path / "case") as case:
        plan = case.record(Kind.PLANNED, {}, by=Actor.SURGEON)
        case.record(Kind.VERIFIED, {"entry_mm": 0.1}, by=Actor.APP, rests_on=[plan.number])
        assert case_report._drilled(case, plan, Recomputed(case)) is None
        case.record(Kind.VERIFIED, {"asked": {}}, by=Actor.APP, rests_on=[plan.number])
        with pytest.raises((KeyError, ValueError)):  # this one says so, and would be measured
            case_report._drilled(case, plan, Recomputed(case))
