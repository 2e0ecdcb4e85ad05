"""The robot's pose at the time of an image: the newest joint values of its stream, with their age."""

import time
from dataclasses import dataclass
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any, Self

from sightline.common.checks import Check
from sightline.errors import LinkError
from sightline.robot.contract import MEASURED_JS
from sightline.robot.igtl import NDArray
from sightline.robot.kinematics.target import FRESH_S
from sightline.robot.link.client import RobotClient

_WAIT_S, _RETRY_S = 1.0, 0.5


@dataclass(frozen=True)
class PoseNow:
    """Joint values (mm, rad) and their age; both None before the first message. `check` says if they may be used."""

    joints: tuple[float, ...] | None
    age_s: float | None

    @property
    def check(self) -> Check:
        """Whether the joint values are recent enough to belong to the image."""
        if self.age_s is None:
            return Check("pose age", False, None, FRESH_S, "s", "pose stale: the robot has not sent its joints yet.")
        fresh = self.age_s <= FRESH_S
        sentence = f"the robot's joints came {self.age_s:.2f} s before the image."
        return Check(
            "pose age", fresh, self.age_s, FRESH_S, "s", sentence.capitalize() if fresh else f"pose stale: {sentence}"
        )

    def document(self) -> dict[str, Any]:
        """Return the pose for an entry, without the joints if they are stale."""
        fresh = self.check.passed
        return {"joints": self.joints if fresh else None, "age_s": self.age_s, "fresh": fresh}


class RobotWatch:
    """Follows the joints of the robot at `host`:`port` while it is entered; it reconnects after a lost link.

    Raises LinkError on entry if the robot cannot be reached.
    """

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._lock, self._leaving = Lock(), Event()
        self._joints: tuple[float, ...] | None = None
        self._heard_s = 0.0

    def __enter__(self) -> Self:
        first = RobotClient(self._host, self._port, heartbeat=False)
        Thread(target=self._follow, args=(first,), name="robot's joints", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leaving.set()

    def now(self) -> PoseNow:
        """Return the newest pose and its age."""
        with self._lock:
            if self._joints is None:
                return PoseNow(None, None)
            return PoseNow(self._joints, time.monotonic() - self._heard_s)

    def _follow(self, client: RobotClient | None) -> None:
        while not self._leaving.is_set():
            try:
                client = client or RobotClient(self._host, self._port, heartbeat=False)
                self._hear(client)
            except LinkError:
                if client is not None:
                    client.close()
                client = None
                self._leaving.wait(_RETRY_S)
        if client is not None:
            client.close()

    def _hear(self, client: RobotClient) -> None:
        body = client.stream(MEASURED_JS, _WAIT_S).body
        if isinstance(body, NDArray) and body.values.ndim == 2 and len(body.values):
            with self._lock:
                self._joints, self._heard_s = tuple(float(q) for q in body.values[0]), time.monotonic()
