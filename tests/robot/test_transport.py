"""Two ends and what lies between: order, bounds, silence, loss and return. Nothing here measures time."""

import asyncio
import functools
import socket
from collections.abc import Callable, Coroutine
from contextlib import closing
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from sightline.errors import LinkError, MessageError
from sightline.robot.igtl import Event, Image, Message, Status, String, Transform, encode
from sightline.robot.transport import BlockingClient, Client, Connection, Server, connection
from sightline.robot.transport import serve as serve_at
from sightline.robot.transport.connection import Outbox

PATIENCE_S = 20.0  # a test that waits longer has failed


def asynchronous(test: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
    """Run a test in an event loop of its own."""

    @functools.wraps(test)
    def run(*args: Any, **options: Any) -> None:
        asyncio.run(test(*args, **options))

    return run


class Witness:
    """A handler that records its callbacks, and answers as configured."""

    def __init__(self, answer: Callable[[Connection, Event], None] = lambda connection, event: None):
        self.told: list[tuple[str, object]] = []
        self.connections: list[Connection] = []
        self._answer = answer

    def opened(self, connection: Connection) -> None:
        self.connections.append(connection)
        self.told.append(("opened", connection))

    def received(self, connection: Connection, event: Event) -> None:
        self.told.append(("received", event))
        self._answer(connection, event)

    def silent(self, connection: Connection) -> None:
        self.told.append(("silent", connection))

    def lost(self, connection: Connection, reason: str) -> None:
        self.told.append(("lost", reason))

    def all(self, what: str) -> list[Any]:
        return [thing for said, thing in self.told if said == what]

    async def until(self, what: str, count: int = 1) -> list[Any]:
        async with asyncio.timeout(PATIENCE_S):
            while len(self.all(what)) < count:
                await asyncio.sleep(0.001)
        return self.all(what)


def echo(connection: Connection, event: Event) -> None:
    if isinstance(event, Message):
        connection.send(event)


def serve(handler: Witness, **options: Any) -> Coroutine[None, None, Server]:
    return serve_at(handler, port=0, **options)


def numbered(number: int, device: str = "arm/measured_cp") -> Message:
    return Message(Transform(np.eye(4)), device, timestamp=number + 1)


@asynchronous
async def test_a_burst_of_one_device_arrives_whole_and_in_order() -> None:
    there, here = Witness(echo), Witness()
    async with await serve(there) as listening, Client(here, port=listening.port) as client:
        for number in range(1000):
            client.connection.send(numbered(number))
        events = await here.until("received", 1000)
        assert [event.timestamp for event in events] == list(range(1, 1001))
        assert len(there.all("received")) == 1000


@asynchronous
async def test_joined_messages_go_out_in_one_write_and_in_order() -> None:
    there, here = Witness(), Witness()
    async with await serve(there) as listening, Client(here, port=listening.port):
        (peer,) = await there.until("opened")
        with patch.object(peer._transport, "write", wraps=peer._transport.write) as write:
            with pytest.raises(ZeroDivisionError), peer.joined():
                peer.send(numbered(0))
                peer.stream(numbered(1))
                assert not write.called
                raise ZeroDivisionError  # what was sent before still goes out
            assert write.call_count == 1
            peer.send(numbered(2))
            assert write.call_count == 2
        assert [event.timestamp for event in await here.until("received", 3)] == [1, 2, 3]


@asynchronous
async def test_a_thread_without_a_loop_talks_to_it() -> None:
    async with await serve(Witness(echo)) as listening:

        def talk() -> None:
            with BlockingClient(port=listening.port) as client:
                for number in range(100):
                    client.send(numbered(number))
                for number in range(100):
                    event = client.receive(PATIENCE_S)
                    assert event.timestamp == number + 1
                assert client.receive(0.0) is None

        await asyncio.to_thread(talk)


@asynchronous
async def test_clients_are_told_apart_and_one_too_many_is_turned_away() -> None:
    there = Witness(lambda peer, event: peer.send(Message(String(peer.peer), "YOU")))
    async with await serve(there) as listening:
        clients = [await asyncio.to_thread(BlockingClient, port=listening.port) for _ in range(connection.MAX_CLIENTS)]
        await there.until("opened", connection.MAX_CLIENTS)
        answers = set()
        for client in clients:
            client.send(Message(String("who am I?")))
            event = await asyncio.to_thread(client.receive, PATIENCE_S)
            answers.add(event.body)
        assert len(answers) == connection.MAX_CLIENTS == len(listening.connections)
        one_more = await asyncio.to_thread(BlockingClient, port=listening.port)
        with pytest.raises(LinkError, match="closed by the peer"):
            await asyncio.to_thread(one_more.receive, PATIENCE_S)
        assert listening.refused == 1
        assert len(there.all("opened")) == connection.MAX_CLIENTS
        clients[0].close()
        await there.until("lost")
        assert len(listening.connections) == connection.MAX_CLIENTS - 1
        for client in clients:
            client.close()


def test_what_waits_is_bounded_in_its_order() -> None:
    box = Outbox()
    box.put_answer(b"first")
    for number in range(connection.TELEMETRY_MESSAGES + 3):
        box.put_telemetry(b"%d" % number)
        if number == 10:
            box.put_answer(b"between")
    sent = [box.take() for _ in range(len(box))]
    kept = [b"%d" % number for number in range(3, connection.TELEMETRY_MESSAGES + 3)]
    assert box.dropped == 3
    assert sent == [b"first", *kept[:8], b"between", *kept[8:]]
    with pytest.raises(KeyError):
        box.take()
    box.put_answer(bytes(2 * connection.ANSWER_BYTES))  # one answer alone may be as large as it likes
    with pytest.raises(LinkError, match="does not read"):
        box.put_answer(b"second")


@asynchronous
async def test_telemetry_to_a_slow_reader_drops_the_oldest_and_answers_arrive() -> None:
    there = Witness()
    async with await serve(there) as listening:
        client = await asyncio.to_thread(BlockingClient, port=listening.port)
        with closing(client):
            (peer,) = await there.until("opened")
            block = np.zeros((200, 1000), dtype=np.uint8)
            count = 0
            while not peer.dropped:  # beyond what the kernel and asyncio hold
                peer.stream(Message(Image(block[None], np.eye(4)), "video", timestamp=count + 1))
                count += 1
            peer.send(Message(Status(1), "ANSWER"))
            seen: list[Message] = []
            while not seen or seen[-1].device_name != "ANSWER":
                event = await asyncio.to_thread(client.receive, PATIENCE_S)
                assert isinstance(event, Message)
                seen.append(event)
            times = [message.timestamp for message in seen[:-1]]
            assert times == sorted(times)
            assert times[-1] == count
            assert len(times) == count - peer.dropped


@asynchronous
async def test_a_client_that_reads_no_answers_is_let_go() -> None:
    there = Witness()
    async with await serve(there) as listening:
        with closing(await asyncio.to_thread(BlockingClient, port=listening.port)):
            (peer,) = await there.until("opened")
            answer = Message(String("x" * 60000))
            while peer.is_open:
                peer.send(answer)
            (reason,) = await there.until("lost")
            assert "does not read" in reason
            peer.send(answer)  # goes nowhere, and says nothing: `lost` did
            assert there.all("lost") == [reason]


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"GET / HTTP/1.1\r\nHost: localhost\r\nUser-Agent: a browser\r\n\r\n", "no header"),
     (encode(numbered(0))[:42] + b"\xff" * 16, "too large")],
)  # fmt: skip
@asynchronous
async def test_bytes_that_lose_the_stream_end_the_connection_and_no_other(data: bytes, reason: str) -> None:
    there, here = Witness(echo), Witness()
    async with await serve(there) as listening, Client(here, port=listening.port) as client:
        with socket.create_connection(("127.0.0.1", listening.port)) as intruder:
            intruder.sendall(data)
            (lost,) = await there.until("lost")
            assert reason in lost
            (event,) = there.all("received")
            assert event.fatal
        client.connection.send(numbered(5))
        (event,) = await here.until("received")
        assert event.timestamp == 6


@pytest.mark.parametrize(("ends", "message_s"), [(False, 0.05), (True, 0.25)])
@asynchronous
async def test_a_message_that_never_ends_is_given_up_and_one_that_ends_later_is_not(
    monkeypatch: pytest.MonkeyPatch, ends: bool, message_s: float
) -> None:
    monkeypatch.setattr(connection, "MESSAGE_S", message_s)
    there, data = Witness(), encode(numbered(1))
    async with await serve(there) as listening:
        with socket.create_connection(("127.0.0.1", listening.port)) as peer:
            peer.sendall(encode(numbered(0)) + data[:-1])
            await there.until("received")
            if ends:
                peer.sendall(data[-1:])
                await there.until("received", 2)
                await asyncio.sleep(2 * message_s)
                assert not there.all("lost")
            else:
                (reason,) = await there.until("lost")
                assert "not complete" in reason
                assert len(there.all("received")) == 1


@asynchronous
async def test_silence_is_told_once_until_the_next_message() -> None:
    there = Witness()
    async with await serve(there, silence_s=0.02) as listening:
        with socket.create_connection(("127.0.0.1", listening.port)) as peer:
            await there.until("silent")
            peer.sendall(encode(numbered(0))[:-8] + b"\x01" * 8)  # a wrong body does not count as a sign of life
            await there.until("received")
            await asyncio.sleep(0.1)
            assert len(there.all("silent")) == 1
            peer.sendall(encode(numbered(1)))
            await there.until("silent", 2)
            assert [said for said, _ in there.told] == ["opened", "silent", "received", "received", "silent"]


@asynchronous
async def test_a_lost_server_is_noticed_and_found_again() -> None:
    here = Witness()
    first = await serve(Witness())
    port = first.port
    async with Client(here, port=port) as client:
        await here.until("opened")
        await first.close()
        assert await here.until("lost") == ["closed by the peer"]
        there = Witness(echo)
        async with await serve_at(there, port=port):
            await here.until("opened", 2)
            async with asyncio.timeout(PATIENCE_S):
                while client.connection is None:
                    await asyncio.sleep(0.001)
            client.connection.send(numbered(1))
            assert len(await here.until("received")) == 1


@asynchronous
async def test_a_handler_that_fails_ends_its_connection_alone(caplog: pytest.LogCaptureFixture) -> None:
    def fail_on_words(peer: Connection, event: Event) -> None:
        if isinstance(event, Message) and isinstance(event.body, String):
            raise ZeroDivisionError
        echo(peer, event)

    there, here = Witness(fail_on_words), Witness()
    async with await serve(there) as listening, Client(here, port=listening.port) as client:
        with closing(await asyncio.to_thread(BlockingClient, port=listening.port)) as other:
            other.send(Message(String("divide")))
            assert await there.until("lost") == ["what was to handle it failed"]
            with pytest.raises(LinkError):
                await asyncio.to_thread(other.receive, PATIENCE_S)
        client.connection.send(numbered(1))
        await here.until("received")
    assert "ZeroDivisionError" in caplog.text


@asynchronous
async def test_nobody_there_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=f"cannot listen at 127.0.0.1:{port}"):
            await serve_at(Witness(), port=port)
    with pytest.raises(LinkError, match="cannot connect"):
        async with Client(Witness(), port=port):
            pass
    with pytest.raises(LinkError, match="cannot connect"):
        BlockingClient(port=port)


@asynchronous
async def test_a_message_that_cannot_be_written_sends_nothing() -> None:
    here = Witness()
    async with await serve(Witness(echo)) as listening, Client(here, port=listening.port) as client:
        with pytest.raises(MessageError, match="21 bytes"):
            client.connection.send(numbered(0, device="a" * 21))
        client.connection.send(numbered(1))
        (event,) = await here.until("received")
        assert event.timestamp == 2


@asynchronous
async def test_closing_says_goodbye_to_a_client_that_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "GOODBYE_S", 0.02)
    monkeypatch.setattr(connection, "prepare", lambda sock: None)  # else the kernel gives it up, after seconds
    there = Witness()
    listening = await serve(there)
    with closing(await asyncio.to_thread(BlockingClient, port=listening.port)):
        (peer,) = await there.until("opened")
        while not peer.dropped:
            peer.stream(Message(String("x" * 60000)))
        await asyncio.wait_for(listening.close(), PATIENCE_S)
        assert there.all("lost") == ["the server ends"]


STOP, TALK = Message(String("STOP"), "CMD_1"), Message(String("HELLO"), "TALK")


def urgent(event: Event) -> bool:
    return isinstance(event, Message) and event.body == STOP.body


async def connected(port: int) -> BlockingClient:
    return await asyncio.to_thread(BlockingClient, port=port)


async def ended(client: BlockingClient) -> bool:
    """Whether the server closes it."""

    def hear() -> bool:
        try:
            return client.receive(PATIENCE_S) is not None
        except Exception:
            return True

    return await asyncio.to_thread(hear)


@asynchronous
async def test_a_stop_is_heard_beyond_the_last_place_and_nothing_else() -> None:
    there = Witness(echo)
    async with await serve(there, kept_for=urgent) as listening:
        held = [await connected(listening.port) for _ in range(connection.MAX_CLIENTS)]
        await there.until("opened", connection.MAX_CLIENTS)
        idle = await connected(listening.port)  # holds the kept place, and is not known
        talks = await connected(listening.port)  # takes it over
        assert await ended(idle)
        talks.send(TALK)
        assert await ended(talks)
        assert listening.refused == 1
        assert len(there.all("opened")) == connection.MAX_CLIENTS
        stops = await connected(listening.port)
        stops.send(STOP)
        assert (await asyncio.to_thread(stops.receive, PATIENCE_S)).body == STOP.body
        stops.send(TALK)  # is not heard
        stops.send(STOP)
        assert (await asyncio.to_thread(stops.receive, PATIENCE_S)).body == STOP.body
        assert [event.body for event in there.all("received")] == [STOP.body, STOP.body]
        stops.close()
        await there.until("lost", 1)
        held[0].close()
        await there.until("lost", 2)
        later = await connected(listening.port)  # an ordinary place
        later.send(TALK)
        assert (await asyncio.to_thread(later.receive, PATIENCE_S)).body == TALK.body
        for client in (*held[1:], later):
            client.close()


@asynchronous
async def test_who_never_says_anything_is_cut_off_and_who_did_is_not() -> None:
    there = Witness(echo)
    async with await serve(there, mute_s=0.05) as listening:
        mute = await connected(listening.port)
        assert await ended(mute)
        assert (await there.until("lost"))[0] == "it said nothing for 0.05 s"
        # Independent of time: the first message cancels the timer.
        speaks = await connected(listening.port)
        (*_, connection) = await there.until("opened", 2)
        listening.received(connection, TALK)
        assert connection not in listening._mute
        speaks.close()
