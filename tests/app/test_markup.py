"""Parts of the page as HTML: what is said of a check."""

import pytest

from sightline.app import texts
from sightline.app.panels.section import checks_html
from sightline.app.panels.steps import StepStatus, judged
from sightline.app.panels.verdict import _number
from sightline.case.views import NAMES
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


def test_what_is_said_alike_of_several_views_is_said_once() -> None:
    alike = [Check("frame tolerances", True, 0.05, None, "mm", f"{view}: assumed.", view=view) for view in NAMES]
    other = Check("frame tolerances", True, 0.06, None, "mm", "pa: assumed.", view="pa")
    html = checks_html([*alike, other], testid="checks", kind="hip-screw")
    assert (html.count("PA and lateral: assumed."), html.count("<li")) == (1, 2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("-0.0", "0.0"),
        ("-0", "0"),
        ("off by -0.00 mm, then -0.0.", "off by 0.00 mm, then 0.0."),
        ("-0.1, -0.05 and 2-0.0 or 1e-0", "-0.1, -0.05 and 2-0.0 or 1e-0"),
    ],
)
def test_a_zero_has_no_sign(text: str, said: str) -> None:
    assert texts.unsigned(text) == said
    assert f">{said}</div>" in checks_html([Check("bead count", True, None, None, "", text)], testid="checks")


def test_a_check_s_value_that_is_zero_has_no_sign() -> None:
    assert '<div class="check-figure">0 mm' in checks_html([Check("head", True, -0.0, None, "mm", ".")], testid="x")
    assert "-" not in _number(-1e-9, "mm", 2)


def test_what_is_not_placed_is_left_to_do_and_needs_no_attention() -> None:
    """Fails where a plan without its landmarks is marked as one that failed a check."""
    unmade = Check("head", False, None, None, "", "head.", missing=True)
    failed = Check("entry error", False, None, None, "", "entry error.")
    assert judged(Verdict((unmade,))) == (StepStatus.OPEN, "head.")
    assert judged(Verdict((unmade, failed))) == (StepStatus.ATTENTION, "entry error.")
    assert judged(Verdict(()))[0] is StepStatus.DONE
