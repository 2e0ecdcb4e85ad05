"""In which order what clients sent is heard."""

import pytest

from sightline.robot.igtl import Message, Status, String
from sightline.robot.inbox import Change, Inbox, stops

ONE, TWO = 1, 2


def command(text: str) -> Message:
    return Message(String(text), "CMD_1")


def taken(inbox: Inbox, waits: int | None = None) -> list:
    out = []
    while (heard := inbox.take(waits)) is not None:
        out.append((heard.client, heard.what.body.text if isinstance(heard.what, Message) else heard.what))
    return out


def test_one_after_the_other():
    inbox = Inbox()
    for client, text in ((ONE, "A"), (TWO, "B"), (ONE, "C")):
        inbox.put(client, command(text))
    assert len(inbox) == 3
    assert taken(inbox) == [(ONE, "A"), (TWO, "B"), (ONE, "C")]
    assert len(inbox) == 0


@pytest.mark.parametrize("text", ["STOP", "EMERGENCY"])
def test_a_stop_is_heard_first_and_says_what_it_overtook(text):
    inbox = Inbox()
    inbox.put(ONE, command("MOVE_TO_TARGET"))
    inbox.put(TWO, command(text))
    inbox.put(ONE, command("RETRACT"))
    assert inbox.stop_waits
    assert inbox.take_stop().client == TWO
    assert inbox.take_stop() is None
    before, after = inbox.take(None), inbox.take(None)
    assert (before.what.body.text, before.overtaken) == ("MOVE_TO_TARGET", True)
    assert (after.what.body.text, after.overtaken) == ("RETRACT", False)


def test_a_client_that_waits_is_heard_afterwards_in_order_and_others_meanwhile():
    inbox = Inbox()
    for client, text in ((ONE, "A"), (TWO, "B"), (ONE, "C")):
        inbox.put(client, command(text))
    assert taken(inbox, waits=ONE) == [(TWO, "B")]
    assert len(inbox) == 2
    inbox.put(TWO, command("STOP"))
    inbox.take_stop()
    inbox.put(ONE, command("D"))
    first = inbox.take(None)
    assert (first.what.body.text, first.overtaken) == ("A", True)
    assert taken(inbox) == [(ONE, "C"), (ONE, "D")]


def test_a_client_that_left_is_not_heard_after_that():
    inbox = Inbox()
    for what in (command("A"), command("B"), Change.LEFT):
        inbox.put(ONE, what)
    inbox.put(TWO, Change.JOINED)
    assert taken(inbox, waits=ONE) == [(ONE, Change.LEFT), (TWO, Change.JOINED)]
    assert taken(inbox) == []


def test_stops_are_commands_of_these_two_words():
    assert stops(command("STOP"))
    assert not stops(command("stop"))
    assert not stops(Message(String("STOP"), "CURRENT_STATUS"))
    assert not stops(Message(Status(1), "CMD_1"))
    assert not stops(Change.LEFT)
