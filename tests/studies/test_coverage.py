"""Coverage as a study: honest errors are found honest, others are not."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from sightline.studies.coverage import LEVELS, Coverage

SMALL = Coverage(methods=("smooth", "localized"), beads_px=(0.1,), frames=("frame exact",))
GROUPS = ["beads 0.1 px", "frame exact", "picks free, 0.1 px", "chain 9in-1k"]


def made_up(scale: float, number: int = 2000) -> list[dict]:
    """Targets of an isotropic stated error, whose actual error is `scale` times that; half of them outside the hull."""
    rng = np.random.default_rng(8)
    out = []
    for k in range(number):
        stated = rng.uniform(0.1, 0.4)  # of one axis, mm
        error = scale * stated * np.linalg.norm(rng.standard_normal(3))
        came = {
            "square": (error / stated) ** 2,
            "error_mm": error,
            "stated_mm": np.sqrt(3) * stated,
            "volume": 1.2,
            "inside": k % 2 == 0,
        }
        out.append({"groups": GROUPS, "smooth": came, "localized": None})
    return out


def shares(summary, group: str) -> list:
    names = {f"smooth, {group}: {p:.0%} ellipsoid holds the target" for p in LEVELS}
    return [figure for figure in summary.estimates if figure.name in names]


def test_honest_errors_are_found_honest():
    summary = SMALL.summary(made_up(1.0))
    for group in ("all", "inside the hull", "outside the hull", *GROUPS):
        for stated, figure in zip(LEVELS, shares(summary, group), strict=True):
            # Four standard deviations of a share of 1,000 or 2,000 targets.
            assert figure.value == pytest.approx(stated, abs=4 * np.sqrt(stated * (1 - stated) / figure.number))
    normalised = next(f for f in summary.estimates if f.name == "smooth, all: normalised error per axis")
    assert normalised.value == pytest.approx(1.0, abs=0.04)
    assert "localized refuses every target." in summary.findings
    assert len(summary.plots) == 1


def test_understated_errors_are_found_out():
    summary = SMALL.summary(made_up(1.3))
    fifty, ninety_five, _ = shares(summary, "all")
    assert fifty.value == pytest.approx(chi2.cdf(chi2.ppf(0.5, 3) / 1.3**2, 3), abs=0.045)
    assert fifty.high < 0.5
    assert ninety_five.high < 0.95
    assert any("21 of 21 shares" in finding for finding in summary.findings)


@pytest.mark.slow
def test_a_trial_states_what_was_predicted_and_what_came():
    trial = SMALL.trial(np.random.default_rng([2, 0]))
    assert json.loads(json.dumps(trial)) == trial
    assert trial["groups"][:2] == ["beads 0.1 px", "frame exact"]
    came = trial["smooth"]
    assert 0.01 < came["stated_mm"] < 3.0
    assert came["square"] >= 0.0
    assert came["volume"] > 0.5
    assert SMALL.trial(np.random.default_rng([2, 0])) == trial
