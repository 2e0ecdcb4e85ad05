"""In which order what clients sent is heard."""

import pytest

from sightline.robot.igtl import Message, Rejected, Status, Stream, String, encode
from sightline.robot.link.inbox import Change, Inbox, stop_of

ONE, TWO = 1, 2


def command(text: str, version: int = 1) -> Message:
    return Message(String(text), "CMD_1", version=version)


def altered(message: Message, at: int = -1) -> Rejected:
    """What a receiver makes of it where its CRC is wrong, or where a byte of its body was altered."""
    data = bytearray(encode(message))
    data[57 if at < 0 else at] ^= 1  # the header's last byte is the CRC's
    (event,) = Stream().feed(bytes(data))
    assert isinstance(event, Rejected)
    return event


def taken(inbox: Inbox, waits: int | None = None, most: int = 100) -> list:
    return [
        (heard.client, heard.what.body.text if isinstance(heard.what, Message) else heard.what)
        for heard in inbox.batch(most, lambda: waits)
    ]


def test_one_after_the_other():
    inbox = Inbox()
    for text in "ABC":
        inbox.put(ONE, command(text))
    assert (len(inbox), inbox.waiting(ONE), inbox.waiting(TWO)) == (3, 3, 0)
    assert taken(inbox) == [(ONE, "A"), (ONE, "B"), (ONE, "C")]
    assert len(inbox) == 0


@pytest.mark.parametrize("text", ["STOP", "EMERGENCY"])
def test_a_stop_is_heard_first_and_says_what_it_overtook(text):
    inbox = Inbox()
    inbox.put(ONE, command("MOVE_TO_TARGET"))
    inbox.put(TWO, command(text))
    inbox.put(ONE, command("RETRACT"))
    assert inbox.stop_waits
    stop, before, after = inbox.batch(100)
    assert (stop.client, stop.what.body.text) == (TWO, text)
    assert (before.what.body.text, before.overtaken) == ("MOVE_TO_TARGET", True)
    assert (after.what.body.text, after.overtaken) == ("RETRACT", False)
    assert not inbox.stop_waits


def test_a_client_that_waits_is_heard_afterwards_in_order_and_others_meanwhile():
    inbox = Inbox()
    for client, text in ((ONE, "A"), (TWO, "B"), (ONE, "C")):
        inbox.put(client, command(text))
    assert taken(inbox, waits=ONE) == [(TWO, "B")]
    assert len(inbox) == 2
    inbox.put(TWO, command("STOP"))
    inbox.put(ONE, command("D"))
    stop, first, *others = inbox.batch(100)
    assert stop.client == TWO
    assert (first.what.body.text, first.overtaken) == ("A", True)
    assert [(other.what.body.text, other.overtaken) for other in others] == [("C", True), ("D", False)]


def test_a_client_that_begins_to_wait_is_not_heard_further():
    inbox, waits = Inbox(), []
    for client, text in ((ONE, "A"), (ONE, "B"), (TWO, "C")):
        inbox.put(client, command(text))
    heard = []
    for one in inbox.batch(100, lambda: waits[0] if waits else None):
        heard.append(one.what.body.text)
        waits.append(ONE)
    assert heard == ["A", "C"]


def test_a_client_that_left_is_not_heard_after_that():
    inbox = Inbox()
    for what in (command("A"), command("B"), command("STOP"), Change.LEFT):
        inbox.put(ONE, what)
    inbox.put(TWO, Change.JOINED)
    assert taken(inbox) == [(ONE, "STOP"), (ONE, Change.LEFT), (TWO, Change.JOINED)]
    assert taken(inbox) == []


def test_who_sends_much_delays_nobody_else():
    inbox = Inbox()
    for number in range(5000):
        inbox.put(ONE, command(f"{number}"))
    inbox.put(TWO, command("A"))
    inbox.put(TWO, command("B"))
    heard = taken(inbox, most=4)
    assert heard == [(ONE, "0"), (TWO, "A"), (ONE, "1"), (TWO, "B")]
    assert inbox.waiting(ONE) == 4998
    assert inbox.waiting(TWO) == 0


def test_what_comes_during_a_turn_waits_for_the_next():
    inbox = Inbox()
    inbox.put(ONE, command("A"))
    for heard in inbox.batch(100):
        inbox.put(ONE, heard.what)
        inbox.put(TWO, Change.LEFT)
    assert len(inbox) == 2


@pytest.mark.parametrize("word", ["STOP", "EMERGENCY", "stop", "Stop ", "STOP\0", "\tEmergency\r\n", "STOP\0\0x"])
@pytest.mark.parametrize("version", [1, 2])
def test_stops_are_commands_that_read_so_whatever_their_crc(word, version):
    assert stop_of(command(word, version)).body.text == word
    said = stop_of(altered(command(word, version)))
    assert (said.body.text, said.device_name) == (word, "CMD_1")


@pytest.mark.parametrize(
    "what",
    [
        command("DRILL"),
        command("STOPPED"),
        command("NON-STOP"),
        command(""),
        altered(command("MOVE_TO_TARGET")),
        altered(command("STOP"), at=-1 + 58 + 4 + 4),  # the last letter is another
        altered(Message(String("STOP"), "TALK")),
        Message(String("STOP"), "CURRENT_STATUS"),
        Message(Status(1), "CMD_1"),
        Change.LEFT,
    ],
    ids=repr,
)
def test_nothing_else_stops(what):
    assert stop_of(what) is None
