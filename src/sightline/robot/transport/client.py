"""A client in an event loop that reconnects when its connection is lost."""

import asyncio
from contextlib import suppress
from types import TracebackType
from typing import Self

from sightline.errors import LinkError
from sightline.robot.transport.connection import Connection, Handler
from sightline.robot.transport.server import LOOPBACK, PORT

CONNECT_S = 2.0  # [ours] a robot in the same room answers in milliseconds
_FIRST_RETRY_S, _LAST_RETRY_S = 0.1, 2.0  # [ours] doubled from one to the other


class Client:
    """`async with Client(handler)` connects, or raises LinkError; later it reconnects when the connection is lost.

    `opened` of the handler is called for every new connection. A robot may have stopped or restarted meanwhile, so
    query its state first. `connection` is None while there is none.
    """

    def __init__(self, handler: Handler, host: str = LOOPBACK, port: int = PORT):
        self.connection: Connection | None = None
        self._handler, self._host, self._port = handler, host, port
        self._keeper: asyncio.Task[None]

    async def __aenter__(self) -> Self:
        self.connection = await self._connect()
        self._keeper = asyncio.create_task(self._keep())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._keeper.cancel()
        with suppress(asyncio.CancelledError):
            await self._keeper
        if self.connection is not None:
            self.connection.close("the client ends")
            await self.connection.wait_closed()
            self.connection = None

    async def _connect(self) -> Connection:
        loop = asyncio.get_running_loop()
        address = f"{self._host}:{self._port}"
        try:
            async with asyncio.timeout(CONNECT_S):
                _, connection = await loop.create_connection(lambda: Connection(self._handler), self._host, self._port)
        except TimeoutError as error:
            raise LinkError(f"{address} did not answer within {CONNECT_S:g} s") from error
        except OSError as error:
            raise LinkError(f"cannot connect to {address}: {error.strerror or error}") from error
        return connection

    async def _keep(self) -> None:
        while True:
            if self.connection is not None:
                await self.connection.wait_closed()
                self.connection = None
            wait_s = _FIRST_RETRY_S
            while self.connection is None:
                await asyncio.sleep(wait_s)
                wait_s = min(2 * wait_s, _LAST_RETRY_S)
                with suppress(LinkError):
                    self.connection = await self._connect()
