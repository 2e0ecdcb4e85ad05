"""Parts of the page as HTML: what is said of a check."""

import pytest

from sightline.app import texts
from sightline.app.panels.section import checks_html
from sightline.app.panels.steps import StepStatus, judged
from sightline.common.checks import Check
from sightline.planning.points.results import Verdict


@pytest.mark.parametrize(
    ("check", "said"),
    [
        (Check("bead count", True, 112.0, 24.0, "beads", "."), "112 beads, at least 24 beads"),
        (Check("bead count", False, 20.0, 24.0, "beads", "."), "20 beads, at least 24 beads"),
        (Check("direction error", True, 0.15, 0.6, "°", "."), "0.15°, at most 0.6°"),
        (Check("direction error", False, 0.71, 0.6, "°", "."), "0.71°, at most 0.6°"),
        (Check("head", False, 1.0004, 1.0, "mm", "."), "1.0004 mm, at most 1 mm"),  # never "1 mm, at most 1 mm"
        (Check("frame tolerances", True, 0.05, None, "mm", "."), "0.05 mm"),
        (Check("head", False, None, None, "", "."), ""),
    ],
)
def test_a_check_says_on_which_side_of_its_limit_its_value_must_be(check: Check, said: str) -> None:
    """Fails where "112 / 24" is read as a share, and where a limit is an upper one by the value alone."""
    assert f'<div class="check-figure">{said}</div>' in checks_html([check], testid="checks")


@pytest.mark.parametrize(
    ("sentence", "said"),
    [
        ("The view pa is 2° from its wanted direction.", "The view PA is 2° from its wanted direction."),
        ("The entry lies 36.4 mm lateral of it.", "The entry lies 36.4 mm lateral of it."),
    ],
)
def test_the_names_of_views_are_those_of_the_page(sentence: str, said: str) -> None:
    """Fails where a check names a view as files do."""
    check = Check("bead count", True, None, None, "", sentence)
    assert f">{said}</div>" in checks_html([check], testid="checks") and texts.sentence(check) == said


@pytest.mark.parametrize(("value", "said"), [(-0.04, "0.0"), (0.04, "0.0"), (-0.06, "-0.1"), (12.34, "12.3")])
def test_a_zero_has_no_sign(value: float, said: str) -> None:
    assert texts.tenths(value) == said


def test_what_is_not_placed_is_left_to_do_and_needs_no_attention() -> None:
    """Fails where a plan without its landmarks is marked as one that failed a check."""
    unmade = Check("head", False, None, None, "", "head.", missing=True)
    failed = Check("entry error", False, None, None, "", "entry error.")
    assert judged(Verdict((unmade,))) == (StepStatus.OPEN, "head.")
    assert judged(Verdict((unmade, failed))) == (StepStatus.ATTENTION, "entry error.")
    assert judged(Verdict(()))[0] is StepStatus.DONE
