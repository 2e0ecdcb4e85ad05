"""Calls of methods of elements in the browser: those of one moment are one message."""

import asyncio
from typing import Any
from weakref import WeakKeyDictionary

from nicegui import Client, core, json
from nicegui.awaitable_response import AwaitableResponse, NullResponse
from nicegui.element import Element

# Each message costs server and page about a millisecond, and a drag makes six calls a move. An error in one call does
# not stop the others.
_CODE = """\
for (const [id, name, args] of {calls}) {{
  try {{ runMethod(id, name, args); }} catch (error) {{ reportError(error); }}
}}"""
_waiting: WeakKeyDictionary[Client, list[tuple[int, str, tuple[Any, ...]]]] = WeakKeyDictionary()


class Calling(Element):
    """An element whose methods are called in the browser in the order of the calls, without an answer."""

    def run_method(self, name: str, *args: Any, timeout: float = 1) -> AwaitableResponse:
        """Call a method with arguments that are JSON types. The response cannot be awaited for a result."""
        if self.is_deleted or not core.is_loop_running():
            return NullResponse()
        calls = _waiting.setdefault(self.client, [])
        calls.append((self.id, name, args))
        if len(calls) == 1:
            asyncio.get_running_loop().call_soon(_send, self.client)
        return NullResponse()


def _send(client: Client) -> None:
    calls = _waiting.pop(client)
    if not client.is_deleted:
        client.run_javascript(_CODE.format(calls=json.dumps(calls)))
