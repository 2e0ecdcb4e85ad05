"""Parts of the page as HTML: what is said of a check."""

import pytest

from sightline.app.panels import markup
from sightline.checks import Check


@pytest.mark.parametrize(
    ("check", "said"),
    [
        (Check("bead count", True, 112.0, 24.0, "beads", "."), "112 beads, at least 24 beads"),
        (Check("bead count", False, 20.0, 24.0, "beads", "."), "20 beads, at least 24 beads"),
        (Check("direction error", True, 0.15, 0.6, "°", "."), "0.15°, at most 0.6°"),
        (Check("direction error", False, 0.71, 0.6, "°", "."), "0.71°, at most 0.6°"),
        (Check("frame tolerances", True, 0.05, None, "mm", "."), "0.05 mm"),
        (Check("head", False, None, None, "", "."), ""),
    ],
)
def test_a_check_says_on_which_side_of_its_limit_its_value_must_be(check: Check, said: str) -> None:
    """Fails where "112 / 24" is read as a share, and where a limit is an upper one by the value alone."""
    assert f'<div class="check-figure">{said}</div>' in markup.checks([check], testid="checks")
