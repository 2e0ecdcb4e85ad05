"""Decisions, their history, and how both come back from what was recorded."""

import json
from datetime import UTC

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.app.plan.decisions import MAX_MARKS, Decisions, Display, History, Mark
from sightline.errors import CaseError

PIXELS = st.tuples(*[st.floats(-0.5, 1023.5)] * 2)
MARKS = st.builds(
    Mark, st.dictionaries(st.sampled_from(["pa", "lateral", "check-pa", "check-lateral"]), PIXELS), st.booleans()
)
DISPLAYS = st.builds(
    Display,
    st.sampled_from([0, 90, 180, 270]),
    st.booleans(),
    st.booleans(),
    st.none() | st.tuples(*[st.floats(1, 4095)] * 2),
)
DECISIONS = st.builds(
    Decisions,
    st.dictionaries(st.sampled_from(["pa", "lateral"]), st.integers(1, 99)),
    st.sampled_from(["hip-screw", "free-wire"]),
    st.sampled_from(["right", "left", None]),
    st.none() | st.text(max_size=8),
    st.dictionaries(st.text(min_size=1, max_size=8), MARKS, max_size=5),
    st.dictionaries(st.sampled_from(["pa", "lateral"]), DISPLAYS),
    st.booleans(),
    st.dictionaries(st.integers(1, 99), st.datetimes(timezones=st.just(UTC))),
    st.dictionaries(st.integers(1, 99), st.booleans()),
)


@given(DECISIONS)
def test_decisions_come_back_from_their_json(decisions):
    assert Decisions.of(json.loads(json.dumps(decisions.document()))) == decisions


@given(st.lists(st.sampled_from(["edit", "undo", "redo"]), max_size=30))
def test_a_history_comes_back_from_what_was_recorded(steps):
    """And undo and redo are what a list with a cursor says."""
    history, recorded, model, at = History(), [], [Decisions()], 0
    for number, step in enumerate(steps):
        if step == "edit":
            decided = Decisions(kind="hip-screw", serial=str(number))
            history.edit(decided)
            model, at = [*model[: at + 1], decided], at + 1
            recorded.append((step, decided))
        elif step == "undo":
            history.undo()
            at = max(at - 1, 0)
            recorded.append((step, None))
        else:
            history.redo()
            at = min(at + 1, len(model) - 1)
            recorded.append((step, None))
        assert history.now == model[at]
        assert history.can_undo == (at > 0)
        assert history.can_redo == (at + 1 < len(model))
    assert History(recorded).now == history.now
    assert History(recorded).revision == history.revision


def test_a_revision_is_never_used_twice():
    history = History()
    seen = [history.revision]
    for what in (lambda: history.edit(Decisions(serial="1")), history.undo, history.redo, history.undo):
        what()
        seen.append(history.revision)
    assert len(set(seen)) == len(seen)


def test_another_image_takes_the_marks_of_the_one_before_away():
    decisions = Decisions(images={"pa": 1}).with_mark(
        "entry", Mark().placed("pa", (3.0, 4.0)).placed("lateral", (5.0, 6.0))
    )
    decisions = decisions.with_mark("only-pa", Mark().placed("pa", (1.0, 1.0)))
    replaced = decisions.with_image("pa", 7, same_pixels=False)
    assert replaced.mark("entry").places == {"lateral": (5.0, 6.0)}
    assert "only-pa" not in replaced.marks
    assert decisions.with_image("pa", 7, same_pixels=True).marks == decisions.marks


def test_a_mark_without_a_place_is_no_mark():
    decisions = Decisions().with_mark("entry", Mark().placed("pa", (3.0, 4.0)))
    assert decisions.with_mark("entry", decisions.mark("entry").placed("pa", None)).marks == {}


def test_too_many_marks_are_refused():
    decisions = Decisions()
    for number in range(MAX_MARKS):
        decisions = decisions.with_mark(str(number), Mark().placed("pa", (0.0, 0.0)))
    with pytest.raises(CaseError, match="at most"):
        decisions.with_mark("one more", Mark().placed("pa", (0.0, 0.0)))


@pytest.mark.parametrize(
    "broken",
    [
        {},
        {"side": "up"},
        {"marks": {"a": {"places": {"pa": [1]}, "free": True}}},
        {"marks": 3},
        {"display": {"pa": {}}},
    ],
)
def test_a_broken_record_is_refused(broken):
    document = {**Decisions().document(), **broken} if broken else {}
    with pytest.raises(CaseError, match="case check"):
        Decisions.of(document)


def test_a_journal_of_before_snapping_was_a_decision_can_be_read():
    document = Decisions(snapping=False).document()
    assert not Decisions.of(document).snapping
    del document["snapping"]
    assert Decisions.of(document).snapping


def test_a_place_on_a_curve_goes_with_the_pixel_that_drew_it():
    places = {"pa": (3.0, 4.0), "lateral": (5.0, 6.0), "check-pa": (7.0, 8.0)}
    assert set(Mark(places, free=False).placed("pa", None).places) == {"check-pa"}
    assert set(Mark(places, free=True).placed("pa", None).places) == {"lateral", "check-pa"}


def test_the_side_is_confirmed_anew_on_another_planning_image():
    decisions = Decisions(images={"pa": 1}, side="right")
    assert decisions.with_image("pa", 2, same_pixels=False).side is None
    assert decisions.with_image("pa", 2, same_pixels=True).side == "right"
    assert decisions.with_image("check-pa", 2, same_pixels=False).side == "right"
