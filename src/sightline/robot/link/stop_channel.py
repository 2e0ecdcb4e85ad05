"""The channel for stops: a separate connection if the robot accepts several, with the main one as fallback."""

from contextlib import suppress
from threading import Event, Lock, Thread

from sightline.errors import LinkError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S
from sightline.robot.igtl import String
from sightline.robot.link.exchange import Exchange, RequestResult
from sightline.robot.link.shared_connection import SharedConnection

# A stop that is not acknowledged on its own connection by then is also sent over the main one [ours]: our robots
# acknowledge in 10 ms.
STOP_ACK_S = 0.2
PROBE_S = 1.0  # period of probes whether the stop connection still answers [ours]


class StopChannel:
    """Stop channel to the robot at `host`:`port`. `main`, `exchange`: the client's main connection and its requests."""

    def __init__(self, host: str, port: int, main: SharedConnection, exchange: Exchange) -> None:
        self._host, self._port, self._main, self._exchange = host, port, main, exchange
        self._one_at_a_time, self._ended = Lock(), Event()
        self._own: SharedConnection | None = None

    def keep_connection(self) -> None:
        """Open a connection for stops and keep it open from now on. While there is none, stops use the main one."""
        self._connect()
        Thread(target=self._keep, name="stop connection", daemon=True).start()

    def close(self) -> None:
        """Close both connections."""
        self._ended.set()
        self._main.close()
        own = self._own
        if own is not None:
            own.close()

    def send(self, name: str) -> RequestResult:
        """Send STOP or EMERGENCY and return its result; concurrent calls run one after the other. Any thread.

        Raises LinkError if no connection answers; both are then closed."""
        with self._one_at_a_time:
            for connection, ack_s in ((self._own, STOP_ACK_S), (self._main, ACK_S)):
                with suppress(LinkError):
                    if connection is not None:
                        return self._exchange.command_over(connection, name, ack_s, STATUS_S)
            self.close()
        raise LinkError(
            f"use the red button: the robot answers no {name} on any connection. All are closed now, which stops a "
            "robot that keeps the contract"
        )

    def _connect(self) -> None:
        with suppress(LinkError):
            self._own = SharedConnection(self._host, self._port)

    def _keep(self) -> None:
        """Probe the connection and reopen it when it is dead, because an idle connection can die unnoticed."""
        while not self._ended.wait(PROBE_S):
            own = self._own
            if own is None:
                self._connect()
                continue
            try:
                own.ask(
                    String(contract.CURRENT_STATUS),
                    contract.CURRENT_STATUS,
                    self._exchange.answers_status,
                    "",
                    marked=False,
                )
            except LinkError:
                own.close()
                self._own = None
        if self._own is not None:
            self._own.close()
