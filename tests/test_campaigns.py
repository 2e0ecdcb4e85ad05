"""Campaigns in short: no try of any class ends in a defect. `make campaign` runs them at length."""

import numpy as np
import pytest
from campaigns.campaign import DEFECTS, Damage, Ended, attempt, called

from sightline.errors import UnusableInputError

TRIES = {"points": 4, "images": 1, "files": 12, "robots": 1}  # of each class


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIES)
def test_no_try_ends_in_a_defect(name: str) -> None:
    for number, (damage_name, damage) in enumerate(called(name).classes.items()):
        for k in range(TRIES[name]):
            ended = attempt(damage.make, np.random.default_rng([91, number, k]))
            assert damage.invisible or ended.how not in DEFECTS, (damage_name, k, ended)


def test_what_is_raised_is_a_refusal_or_a_crash() -> None:
    def refuses(_: np.random.Generator) -> Ended:
        raise UnusableInputError("the image is torn")

    def falls(_: np.random.Generator) -> Ended:
        raise ZeroDivisionError

    rng = np.random.default_rng(1)
    assert attempt(refuses, rng) == Ended("refused", "UnusableInputError", said="the image is torn")
    assert attempt(falls, rng).how == "crash"


def test_a_summary_counts_defects_but_of_invisible_classes() -> None:
    whole = called("points")
    hidden = next(name for name, damage in whole.classes.items() if damage.invisible)
    seen = next(name for name, damage in whole.classes.items() if not damage.invisible)
    wrong = {"how": "wrong", "why": "off", "ratio": 2.0, "said": "", "named": None}
    right = {**wrong, "how": "right", "ratio": 0.5}
    assert whole.summary([{"class": hidden, **wrong}, {"class": seen, **right}]).findings == ("No defect.",)
    assert whole.summary([{"class": seen, **wrong}]).findings == (f"{seen}: wrong 1 times: off",)


def test_a_refusal_names_its_cause_or_does_not() -> None:
    def torn(_: np.random.Generator) -> Ended:
        raise UnusableInputError("the image is torn at row 3")

    from campaigns.campaign import Campaign

    rng = np.random.default_rng(2)
    for cause, named in ((("torn",), True), (("blurred",), False), ((), None)):
        assert Campaign("one", "", {"a": Damage(torn, cause)}).trial(rng)["named"] is named
