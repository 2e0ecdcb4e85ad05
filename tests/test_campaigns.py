"""Campaigns in short: no try of any class ends in a defect. `make campaign` runs them at length."""

from dataclasses import replace

import numpy as np
import pytest
from campaigns import images, points
from campaigns.campaign import DEFECTS, Damage, Ended, attempt, called
from campaigns.points import World
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError

TRIES = {"points": 1, "images": 1, "files": 2, "robots": 1, "kills": 1, "pages": 1}  # of each class


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIES)
def test_no_try_ends_in_a_defect(name: str, few_pixels: None, monkeypatch: pytest.MonkeyPatch) -> None:
    # Four patients, each of which is rendered: right hips, two with each frame.
    base = images.base
    monkeypatch.setattr(images, "BASES", 8)
    monkeypatch.setattr(images, "base", lambda number: base(number & 6))
    for number, (damage_name, damage) in enumerate(called(name).classes.items()):
        for k in range(TRIES[name]):
            ended = attempt(damage.make, np.random.default_rng([91, number, k]))
            assert ended.how not in DEFECTS, (damage_name, k, ended)


def test_what_is_raised_is_a_refusal_or_a_crash() -> None:
    def refuses(_: np.random.Generator) -> Ended:
        raise UnusableInputError("the image is torn")

    def falls(_: np.random.Generator) -> Ended:
        raise ZeroDivisionError

    rng = np.random.default_rng(1)
    assert attempt(refuses, rng) == Ended("refused", "UnusableInputError", said="the image is torn")
    assert attempt(falls, rng).how == "crash"


def test_a_summary_counts_defects_but_not_what_cannot_be_seen() -> None:
    whole = called("points")
    name = next(iter(whole.classes))
    wrong = {"class": name, "how": "wrong", "why": "off", "ratio": 2.0, "said": "", "named": None}
    right, unseen = {**wrong, "how": "right", "ratio": 0.5}, {**wrong, "how": "unseen"}
    assert whole.summary([right, unseen]).findings == ("No defect.",)
    assert whole.summary([right, wrong]).findings == (f"{name}: wrong 1 times: off",)


def moved_across(world: World, _: np.random.Generator) -> None:
    """2 mm along the common normal of the beams, where movement is seen."""
    normal = np.cross(*(view.focal_point_mm - world.hip.head_mm for view in world.setup.views.values()))
    motion = RigidTransform.from_translation(2.0 * normal / np.linalg.norm(normal))
    world.moved = replace(world.hip, motions={"lateral": motion}).at("lateral")
    world.reclick(world.hip, np.random.default_rng(1), lateral=world.moved)


@pytest.mark.parametrize("change", [points.nothing, points.scaled_frame, points.one_pick_along])
def test_these_cannot_be_seen_in_any_observation(change: points.Change) -> None:
    """docs/safety.md, What is not covered."""
    assert all(points.apart(change, np.random.default_rng([3, k])) < points.UNSEEN for k in range(2))


@pytest.mark.slow
@pytest.mark.parametrize("change", [points.one_pick_off, points.careless, moved_across])
def test_these_can_be_seen(change: points.Change) -> None:
    """So that the measure is one."""
    assert all(points.apart(change, np.random.default_rng([3, k])) > points.WEAK for k in range(2))


def test_a_refusal_names_its_cause_or_does_not() -> None:
    def torn(_: np.random.Generator) -> Ended:
        raise UnusableInputError("the image is torn at row 3")

    from campaigns.campaign import Campaign

    rng = np.random.default_rng(2)
    for cause, named in ((("torn",), True), (("blurred",), False), ((), None)):
        assert Campaign("one", "", {"a": Damage(torn, cause)}).trial(rng)["named"] is named
