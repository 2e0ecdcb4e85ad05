"""How many clients a server takes, and what it keeps a place for."""

import asyncio

from tests.robot.test_transport import PATIENCE_S, Witness, echo, serve

from sightline.robot.igtl import Event, Message, String
from sightline.robot.transport import BlockingClient
from sightline.robot.transport import connection as server

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


def test_a_stop_is_heard_beyond_the_last_place_and_nothing_else() -> None:
    async def main() -> None:
        there = Witness(echo)
        async with await serve(there, kept_for=urgent) as listening:
            held = [await connected(listening.port) for _ in range(server.MAX_CLIENTS)]
            await there.until("opened", server.MAX_CLIENTS)
            idle = await connected(listening.port)  # holds the kept place, and is not known
            talks = await connected(listening.port)  # takes it over
            assert await ended(idle)
            talks.send(TALK)
            assert await ended(talks)
            assert listening.refused == 1
            assert len(there.all("opened")) == server.MAX_CLIENTS
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

    asyncio.run(main())


def test_who_never_says_anything_is_cut_off_and_who_did_is_not() -> None:
    async def main() -> None:
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

    asyncio.run(main())
