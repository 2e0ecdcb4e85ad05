"""Which client commands, and whether it has fallen silent. Times are the robot's own (robot/control/own_time.py)."""

from sightline.robot.contract import SILENCE_S


class Lease:
    """One client may hold it, by its number; silence is noticed of those that have promised heartbeats."""

    def __init__(self) -> None:
        self.holder: int | None = None
        self._heard_s: dict[int, float] = {}

    def heartbeat(self, client: int, now_s: float) -> None:
        """A sign of life, or the promise of more."""
        self._heard_s[client] = now_s

    def heard(self, client: int, now_s: float) -> None:
        """Any other message; it counts where the client has promised heartbeats."""
        if client in self._heard_s:
            self._heard_s[client] = now_s

    def take(self, client: int) -> bool:
        """Take it if it is free. Whether this client holds it now."""
        if self.holder is None:
            self.holder = client
        return self.holder == client

    def left(self, client: int) -> bool:
        """The client is gone. Whether it held the lease, which is free then."""
        self._heard_s.pop(client, None)
        if client != self.holder:
            return False
        self.holder = None
        return True

    def silence(self, begun_s: float, now_s: float, unread_s: float) -> str | None:
        """Why a motion that began at `begun_s` must end: its client said nothing for too long, up to what came in the
        last `unread_s`; or the robot did not read that for too long, and would hear no stop."""
        heard_s = self._heard_s.get(-1 if self.holder is None else self.holder)
        if heard_s is not None and now_s - unread_s - max(heard_s, begun_s) > SILENCE_S:
            return f"the client was silent for {SILENCE_S:g} s"
        if min(unread_s, now_s - begun_s) > SILENCE_S:
            return f"the robot did not read its own link for {SILENCE_S:g} s: its computer is too busy"
        return None
