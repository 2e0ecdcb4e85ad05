"""The command lease: which client commands, and whether it is silent. Times are those of the robot's LoopClock."""

from sightline.robot.contract import SILENCE_S


class Lease:
    """One client, by its number, may hold the lease. Only clients that announced heartbeats are watched for silence."""

    def __init__(self) -> None:
        self.holder: int | None = None
        self._heard_s: dict[int, float] = {}

    def heartbeat(self, client: int, now_s: float) -> None:
        """Record a heartbeat, or the announcement of heartbeats."""
        self._heard_s[client] = now_s

    def heard(self, client: int, now_s: float) -> None:
        """Record any other message; it counts only for clients that announced heartbeats."""
        if client in self._heard_s:
            self._heard_s[client] = now_s

    def take(self, client: int) -> bool:
        """Acquire the lease if it is free. Returns whether this client holds it now."""
        if self.holder is None:
            self.holder = client
        return self.holder == client

    def left(self, client: int) -> bool:
        """Remove a client. Returns whether it held the lease, which is then free."""
        self._heard_s.pop(client, None)
        if client != self.holder:
            return False
        self.holder = None
        return True

    def silence(self, begun_s: float, now_s: float, unread_s: float) -> str | None:
        """Return why a motion that began at `begun_s` must end, or None.

        Either its client was silent for too long, not counting the last `unread_s` that may be unread; or the robot
        did not read its link for too long and would miss a stop."""
        heard_s = self._heard_s.get(-1 if self.holder is None else self.holder)
        if heard_s is not None and now_s - unread_s - max(heard_s, begun_s) > SILENCE_S:
            return f"the client was silent for {SILENCE_S:g} s"
        if min(unread_s, now_s - begun_s) > SILENCE_S:
            return f"the robot did not read its own link for {SILENCE_S:g} s: its computer is too busy"
        return None
