"""The conformance test finds ours conforming, tells an old robot from a bad one, and our client drives them all."""

import pytest
from tests.robot.rig import IMAGED, served
from tests.robot.scripted_robot import SERIAL, ScriptedRobot, scripted, serving

from sightline.robot.link.conformance.examination import QUESTIONS, ConformanceVerdict, Examination
from sightline.robot.link.conformance.poses import MOTIONS


def failed(findings) -> set[str]:
    return {finding.name for finding in findings if finding.verdict is ConformanceVerdict.FAILED}


def unjudged(findings) -> set[str]:
    judged = (ConformanceVerdict.PASSED, ConformanceVerdict.FAILED)
    return {finding.name for finding in findings if finding.verdict not in judged}


@pytest.mark.slow
def test_ours_passes_everything_and_stands_after_the_dry_run():
    with served(ideal=True) as server, Examination("127.0.0.1", server.port, SERIAL) as robot:
        robot.draw_back()
        findings = robot.examine() + robot.dry_run()
        bad = {f.name: f.seen for f in findings if f.verdict is not ConformanceVerdict.PASSED}
        assert not bad
        assert {f.name for f in findings} == {"every message can be read", *QUESTIONS, *MOTIONS}
        depth = server.dialogue.controller.machine.snapshot().depth_mm
        assert depth is None or depth < -15.0  # it stood at its stand-off
        assert server._plant.q[:4] == pytest.approx(IMAGED[:4], abs=0.01)  # on the line where it was found


PLANS = {
    "takes NO-GO": "plan that is NO-GO: 10", "takes half a plan": "plan that leaves out a key: 10",
    "takes any side": "plan of the other side: 10", "takes any serial": "plan of another frame: 10",
    "takes an expired plan": "plan that has expired: 10", "takes a plan for ever": "plan that is valid too long: 10",
    "takes an old plan anew": "plan that is sent again after it expired: 10",
    "takes any depth limit": "plan without a depth limit: 10", "takes any depth": "plan whose depth is no number: 10",
}  # fmt: skip
OURS_ALONE = {
    "a repeated command acts once", "an identifier used for another command: 10",
    "SHOT_DEPTH outside PAUSED is refused", "SHOT_DEPTH of NaN is refused",
    "dry run: a repeated command moves nothing",
    "registration in metres: 10", "target in metres: 10", "target in another frame: 10", "target in another unit: 10",
    *PLANS.values(), "STOP on a second connection", "one client holds the lease",
    "forgets a lost client", "streams", "EMERGENCY waits for a reset", "a reset names its fault",
    "dry run: STOP while moving, on a second connection", "dry run: silence stops motion",
    "dry run: a lost client's motion stops", "dry run: MOVE_TO_TARGET by an expired plan: 10",
    "dry run: DRILL without alignment: 13", "dry run: GUIDE without alignment: 13",
    "dry run: DRILL without heartbeats: 13", "dry run: states its depth",
}  # fmt: skip


@pytest.mark.slow
def test_a_robot_of_2013_is_asked_what_it_knows_over_one_connection():
    """It takes one client, whose STATUS or second connection it would not expect, and ends with it."""
    peer = ScriptedRobot(ours=False, clients=1, says_reachable=False)
    came = []
    with serving(peer) as port, Examination("127.0.0.1", port, SERIAL) as robot:
        came += peer.peers
        findings = robot.examine() + robot.dry_run()
        assert peer.peers == came
    assert failed(findings) == set()
    assert unjudged(findings) == OURS_ALONE | {"REACHABLE_TARGET is the target"}
    assert ConformanceVerdict.NOT_ASKED not in {finding.verdict for finding in findings}
    assert peer.turned_away == 0
    assert not peer.unexpected


# Each fault of a robot by the one line that it fails, or by all that ask for what it leaves out.
FAULTS: list[tuple[str, str | set[str]]] = [
    ("late ACK", "commands are acknowledged in time"),
    ("another ACK text", "ACK carries the command's text"),
    ("STATUS before ACK", "answers come in their order"),
    ("ignores unknown commands", "unknown command: 12"),
    ("wrong phase", "the phase is told"),
    ("no PLANNING from START_UP", "PLANNING from START_UP"),
    ("TARGETING without calibration", "TARGETING without calibration: 13"),
    ("moves without a target", "MOVE_TO_TARGET without target: 13"),
    ("acts on a repeat", "a repeated command acts once"),
    ("refuses a repeat", "a repeated command acts once"),
    ("takes an identifier twice", "an identifier used for another command: 10"),
    ("takes a shot at any time", "SHOT_DEPTH outside PAUSED is refused"),
    ("takes any shot", "SHOT_DEPTH of NaN is refused"),
    ("takes no registration", "takes a registration"),
    ("echoes another registration", "ACK echoes a registration"),
    ("takes a registration that is not rigid", "registration that is no rotation: 10"),
    ("takes a registration that is not finite", "registration of NaN: 10"),
    ("takes a registration in metres", "registration in metres: 10"),
    ("echoes another target", "ACK echoes a target"),
    ("would lay it aside", "REACHABLE_TARGET is the target"),
    ("would lay it deeper", "REACHABLE_TARGET is the target"),
    ("takes a target that is not rigid", "target that is no rotation: 10"),
    ("takes a target that is not finite", "target of NaN: 10"),
    ("takes a target out of reach", "target out of reach: 10"),
    ("takes metres", "target in metres: 10"),
    ("takes any frame", "target in another frame: 10"),
    ("takes any unit", "target in another unit: 10"),
    *PLANS.items(),
    ("ignores STOP while standing", {"STOP is obeyed in every phase", "STOP on a second connection"}),
    ("stops for its own client only", "STOP on a second connection"),
    ("ignores CRCs", "a command with a wrong CRC is not obeyed"),
    ("hangs up on a wrong CRC", "survives a wrong CRC"),
    ("answers a wrong CRC with text", "survives a wrong CRC"),
    ("hangs up on unknown types", "survives an unknown type"),
    ("whole pieces only", "reads a message in pieces"),
    ("deaf to metadata", "reads header version 2"),
    ("no lease", "one client holds the lease"),
    ("keeps a lost client", "forgets a lost client"),
    ("NaN in its joints", "streams"),
    ("five rows of joints", "streams"),
    ("obeys in EMERGENCY", "EMERGENCY waits for a reset"),
    ("any reset", "a reset names its fault"),
    ("sends wrong CRCs", "every message can be read"),
]  # fmt: skip
FAULTS_IN_MOTION = {
    "lays it aside": {"dry run: aligns, and stands"},
    "ignores STOP while moving": {"dry run: STOP while moving", "dry run: STOP while moving, on a second connection"},
    "deaf to others while moving": {"dry run: STOP while moving, on a second connection"},
    "moves on a repeat": {"dry run: a repeated command moves nothing"},
    "never notices silence": {"dry run: silence stops motion"},
    "goes on without its client": {"dry run: a lost client's motion stops"},
    "moves in MANUAL": {"dry run: MOVE_TO_TARGET in MANUAL: 14 or 13"},
    "moves by an expired plan": {"dry run: MOVE_TO_TARGET by an expired plan: 10"},
    "keeps a refused target": {"dry run: MOVE_TO_TARGET after a refused target: 13"},
    "drills unaligned": {"dry run: DRILL without alignment: 13"},
    "guides unaligned": {"dry run: GUIDE without alignment: 13"},
    "drills without heartbeats": {"dry run: DRILL without heartbeats: 13"},
    "drifts while it holds": {"dry run: holds still when aligned"},
    "NaN as depth": {"dry run: states its depth"},
    "aligns in the bone": {"dry run: aligns, and stands"},
}
# Faults that do not touch each other: one robot has several, and fails the lines of each. With the steps of its motion,
# which must not have ended before it is judged.
IN_MOTION_TOGETHER = [
    (25, "lays it aside", "moves in MANUAL", "moves by an expired plan", "keeps a refused target", "drills unaligned",
     "drifts while it holds", "NaN as depth"),
    (25, "aligns in the bone", "drills without heartbeats", "guides unaligned"),
    (150, "deaf to others while moving", "moves on a repeat", "goes on without its client"),
    (300, "ignores STOP while moving", "never notices silence"),
]  # fmt: skip


@pytest.fixture(autouse=True)
def short_hold(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.conformance.poses.HOLD_S", 0.6)


# As above, of faults that show without a motion.
TOGETHER = [
    ("another ACK text", "echoes another registration", "takes metres", "NaN in its joints", "takes any side",
     "takes any shot"),
    ("acts on a repeat", "takes any frame", "takes a registration that is not rigid", "any reset",
     "hangs up on unknown types", "takes any serial"),
    ("takes an identifier twice", "takes any unit", "takes a registration that is not finite", "five rows of joints",
     "takes a shot at any time", "hangs up on a wrong CRC", "takes an expired plan", "takes an old plan anew"),
    ("refuses a repeat", "echoes another target", "takes NO-GO", "no lease", "TARGETING without calibration",
     "takes a plan for ever", "takes a registration in metres", "ignores STOP while standing"),
    ("would lay it aside", "takes half a plan", "takes a target that is not rigid", "stops for its own client only",
     "takes a target out of reach", "takes any depth"),
    ("takes a target that is not finite", "sends wrong CRCs", "obeys in EMERGENCY", "moves without a target",
     "ignores CRCs", "takes any depth limit"),
    ("would lay it deeper", "wrong phase", "STATUS before ACK", "answers a wrong CRC with text"),
    ("no PLANNING from START_UP", "takes no registration"),
]  # fmt: skip
LINES = {flaw: {lines} if isinstance(lines, str) else lines for flaw, lines in FAULTS}
# Found by what does not come within its time.
WAITED_FOR = ("late ACK", "keeps a lost client", "ignores unknown commands", "deaf to metadata", "whole pieces only")


@pytest.mark.parametrize(
    "flaws",
    [
        *TOGETHER,
        pytest.param(WAITED_FOR, marks=pytest.mark.slow),
    ],
    ids=", ".join,
)
def test_a_bad_robot_fails_the_line_of_each_of_its_faults(flaws):
    with scripted(*flaws) as port, Examination("127.0.0.1", port, SERIAL) as robot:
        assert failed(robot.examine()) == set().union(*(LINES[flaw] for flaw in flaws))


@pytest.mark.parametrize(
    ("steps", "flaws"),
    [
        pytest.param(steps, flaws, id=", ".join(flaws), marks=[pytest.mark.slow] if k else [])
        for k, (steps, *flaws) in enumerate(IN_MOTION_TOGETHER)
    ],
)
def test_a_robot_that_is_bad_in_motion_fails_its_own_lines(steps, flaws):
    with scripted(*flaws, steps=steps) as port:
        with Examination("127.0.0.1", port, SERIAL) as robot:
            found = robot.dry_run()
        assert failed(found) == set().union(*(FAULTS_IN_MOTION[flaw] for flaw in flaws))


def test_every_question_has_its_bad_robot():
    assert sorted(flaw for group in (*TOGETHER, WAITED_FOR) for flaw in group) == sorted(LINES)
    asked = {question for _, question in FAULTS if isinstance(question, str)} | {"STOP is obeyed in every phase"}
    asked |= set().union(*FAULTS_IN_MOTION.values())
    assert sorted(flaw for _, *flaws in IN_MOTION_TOGETHER for flaw in flaws) == sorted(FAULTS_IN_MOTION)
    assert asked == {"every message can be read", *QUESTIONS, *MOTIONS}


@pytest.mark.slow
def test_a_motion_that_ends_by_itself_is_not_taken_for_a_stop():
    with scripted("ignores STOP while moving", steps=1) as port, Examination("127.0.0.1", port, SERIAL) as robot:
        assert "dry run: STOP while moving" in unjudged(robot.dry_run())
