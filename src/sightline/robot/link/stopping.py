"""The connection for stops: one of its own where the robot takes several, and the main one where that is dead."""

from contextlib import suppress
from threading import Event, Lock, Thread

from sightline.errors import LinkError
from sightline.robot import contract
from sightline.robot.contract import ACK_S, STATUS_S
from sightline.robot.igtl import String
from sightline.robot.link.exchange import Exchange, Said
from sightline.robot.link.talk import Talk

# A stop that is not acknowledged on its own connection by then goes over the main one too [ours]: a robot of ours
# acknowledges in 10 ms.
STOP_ACK_S = 0.2
PROBE_S = 1.0  # between two checks whether the stop's connection still answers [ours]


class Stopping:
    """Stops for the robot behind `host`:`port`, that of `main` and its `exchange`."""

    def __init__(self, host: str, port: int, main: Talk, exchange: Exchange) -> None:
        self._host, self._port, self._main, self._exchange = host, port, main, exchange
        self._one_at_a_time, self._ended = Lock(), Event()
        self._own: Talk | None = None

    def keep_connection(self) -> None:
        """Make a connection for stops alone, and keep it from now on. Where there is none, stops go over the main
        one."""
        self._connect()
        Thread(target=self._keep, name="stop connection", daemon=True).start()

    def close(self) -> None:
        """End both connections."""
        self._ended.set()
        self._main.close()
        own = self._own
        if own is not None:
            own.close()

    def send(self, name: str) -> Said:
        """Send STOP or EMERGENCY, several at once one after the other, each answered. Any thread.

        Raises LinkError where no connection answers; both are closed then."""
        with self._one_at_a_time:
            for talk, ack_s in ((self._own, STOP_ACK_S), (self._main, ACK_S)):
                with suppress(LinkError):
                    if talk is not None:
                        return self._exchange.command_over(talk, name, ack_s, STATUS_S)
            self.close()
        raise LinkError(
            f"the robot answers no {name} on any connection; all are closed, which stops a robot that keeps the "
            "contract. Use the red button"
        )

    def _connect(self) -> None:
        with suppress(LinkError):
            self._own = Talk(self._host, self._port)

    def _keep(self) -> None:
        """A connection on which nothing is said may be dead without a sign: it is asked, and made anew."""
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
