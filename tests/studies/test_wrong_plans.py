"""Wrong plans as a study: each is wrong by what is stated, its own check refuses it, and without the check it is GO."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.planning import bone

from sightline.planning import Plan, kind, plan
from sightline.studies import wrong_plans
from sightline.studies.wrong_plans import UNSEEN, VIOLATED, PlanPixels, WrongPlans, verdict_name
from sightline.studies.wrong_wires import KINDS, NEAR_TIMES, KnownBone, WrongKind, draw_times


def _once(draw: Callable[..., PlanPixels]) -> Callable[..., PlanPixels]:
    """`draw`, which draws at its first call; later ones return the same, and leave the generator as the first did."""
    kept: list[Any] = []

    def drawn(rng: np.random.Generator, *of: Any) -> PlanPixels:
        if not kept:
            kept.extend((draw(rng, *of), rng.bit_generator.state))
        rng.bit_generator.state = kept[1]
        return kept[0]

    return drawn


@pytest.mark.parametrize(
    "of", [pytest.param(of, id=of.name, marks=pytest.mark.slow if k % 10 else ()) for k, of in enumerate(KINDS)]
)
def test_a_wrong_plan_is_caught_by_its_own_check_and_is_go_without_it(of: WrongKind, monkeypatch: pytest.MonkeyPatch):
    """Both trials are on one bone. One in ten is drawn twice, which shows that a trial repeats."""
    seed = [46, KINDS.index(of)]
    if seed[1] % 10:
        monkeypatch.setattr(wrong_plans, "_drawn", _once(wrong_plans._drawn))
    trial = WrongPlans(kinds=(of.name,)).trial(np.random.default_rng(seed))
    assert trial["kind"] == of.name
    assert trial["times"] >= VIOLATED
    assert trial["wrong"]["ended"] == "NO-GO"
    assert verdict_name(of.check) in trial["wrong"]["why"]
    assert json.loads(json.dumps(trial)) == trial
    unchecked = WrongPlans(kinds=(of.name,), without=(of.check, *of.also)).trial(np.random.default_rng(seed))
    assert unchecked["times"] == trial["times"]
    assert unchecked["wrong"]["ended"] == "GO", unchecked["wrong"]["why"]


def test_three_sizes_of_four_are_near_the_limit():
    times = np.array([draw_times(np.random.default_rng([46, k])) for k in range(2000)])
    assert times.min() >= VIOLATED and times.max() <= 15.0
    assert np.mean(times <= NEAR_TIMES) == pytest.approx(0.75, abs=0.04)  # 4 s.d. of a share of 2,000


def test_the_summary_counts_what_is_go():
    other = next(one for one in KINDS if one.check == "side" and one.procedure != KINDS[0].procedure)
    names = [KINDS[0].name, other.name]
    ended = {"GO": {"ended": "GO", "why": []}, "NO-GO": {"ended": "NO-GO", "why": ["gap", "side"]}}
    trials = [
        {"frame": frame, "kind": name, "times": times, "hidden": UNSEEN[0]}
        | {"wrong": ended[wrong], "right": ended[right], "unseen": ended[unseen]}
        for frame, name, times, wrong, right, unseen in [
            ("gamma", names[0], 4.0, "GO", "GO", "GO"),
            ("gamma", names[1], 9.0, "NO-GO", "GO", "GO"),
            ("block60", names[1], 3.6, "NO-GO", "NO-GO", "NO-GO"),
        ]
    ]
    summary = WrongPlans(kinds=tuple(names)).summary(trials)
    rows = {row[0]: row[1:] for row in summary.tables[0].rows}
    assert rows["all"] == ("3", "1 of 3", "66.7%", "gap 2", "66.7%", "gap 1, side 1")
    assert rows[names[0]] == ("1", "1 of 1", "0.0%", "", "100.0%", "")
    assert rows["Γ on the intensifier"][:2] == ("2", "1 of 2")
    assert "1 of 3 wrong plans are GO; 67% of them violate by 5 times or less." in summary.findings
    assert names[1] in summary.plots[0].svg
    assert [row[:3] for row in summary.tables[1].rows] == [
        (UNSEEN[0], "3", "0.667 (0.0943 to 0.992)"),
        (f"{UNSEEN[0]}, {KINDS[0].procedure}", "1", "1 (0.025 to 1)"),
        (f"{UNSEEN[0]}, {other.procedure}", "2", "0.5 (0.0126 to 0.987)"),
        (UNSEEN[1], "0", "none"),
    ]


@pytest.mark.slow
def test_the_stated_error_of_a_check_is_that_of_the_clicks():
    """120 draws of all clicks on two stand-in views whose own errors are small: their s.d. is known to 6.5 %."""
    views, rng = bone.views(), np.random.default_rng(45)
    uv, rules = bone.pixels(views), {rule.check: rule for rule in kind("hip-screw").checks}
    mark = np.array([view.project(bone.LESSER_MM[None]) for view in views])

    def planned(sd_px: float) -> Plan:
        drawn = {name: [px + sd_px * rng.standard_normal(px.shape) for px in both] for name, both in uv.items()}
        wire = np.array(drawn["wire"])
        return plan(
            views,
            wire[:, 0],
            wire[:, 1],
            side="right",
            aids=bone.aids(drawn),
            landmarks_uv_px=mark + sd_px * rng.standard_normal(mark.shape),
            landmark_names=("lesser-trochanter",),
            curve=lambda *_: bone.curve_once(),
        )

    exact = KnownBone.of(planned(0.0))
    names = ("entry below cortex", "lateral of lesser trochanter", "wire to shaft", "tip in head", "tip-apex distance")
    many = [KnownBone.of(planned(0.5)) for _ in range(120)]
    for name in names:
        scatter = 1.96 * np.std([one.beyond(rules[name]) for one in many])
        assert exact.error_95(rules[name]) == pytest.approx(scatter, rel=0.2)
