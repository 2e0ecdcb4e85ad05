"""Record of drilling: depth and force as sent over the link, and the events from the robot's supervision."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.robot import contract
from sightline.robot.igtl import Message, Sensor, String

_EVENT = re.compile(r"([a-z -]{1,40}); (-?\d{1,6}\.\d\d) mm; (-?\d{1,6}\.\d) N")


@dataclass(frozen=True)
class DrillingEvent:
    """An event of supervision, at `depth_mm` beyond the entry point and a filtered force of `force_n`."""

    name: str
    depth_mm: float
    force_n: float


@dataclass(frozen=True, eq=False)
class DrillingRecord:
    """`depth_mm` beyond the entry point and `force_n`, (N,) in order of arrival; `events` likewise. `depth_sd_mm` (N,):
    standard deviation of the depth; None from a robot that states none."""

    depth_mm: np.ndarray
    force_n: np.ndarray
    events: tuple[DrillingEvent, ...]
    depth_sd_mm: np.ndarray | None = None

    def document(self) -> dict[str, Any]:
        """Return the record as JSON types."""
        events = [vars(event) for event in self.events]
        sd = None if self.depth_sd_mm is None else self.depth_sd_mm.tolist()
        return {
            "depth_mm": self.depth_mm.tolist(),
            "depth_sd_mm": sd,
            "force_n": self.force_n.tolist(),
            "events": events,
        }

    @staticmethod
    def of(document: Mapping[str, Any]) -> "DrillingRecord":
        """Return the record from JSON types."""
        sd = document.get("depth_sd_mm")
        return DrillingRecord(
            np.array(document["depth_mm"]),
            np.array(document["force_n"]),
            tuple(DrillingEvent(**event) for event in document["events"]),
            None if sd is None else np.array(sd),
        )


class Recorder:
    """Collects a record: add `heard` to a client's `listeners`, and read `record`. Other messages are ignored."""

    def __init__(self) -> None:
        self._force_n = self._sd_mm = np.nan
        self._samples: list[tuple[float, float, float]] = []  # depth, force, error of depth
        self._events: list[DrillingEvent] = []

    def heard(self, message: Message) -> None:
        """Add a message from the robot."""
        body = message.body
        if isinstance(body, Sensor) and len(body.values) == 1:
            value = float(body.values[0])
            if message.device_name == contract.FORCE:
                self._force_n = value
            elif message.device_name == contract.DEPTH_SD:
                self._sd_mm = value
            elif message.device_name == contract.DEPTH and np.isfinite([value, self._force_n]).all():
                self._samples.append((value, self._force_n, self._sd_mm))
        elif isinstance(body, String) and message.device_name == contract.EVENT:
            match = _EVENT.fullmatch(body.text)
            if match is not None:
                self._events.append(DrillingEvent(match[1], float(match[2]), float(match[3])))

    @property
    def record(self) -> DrillingRecord:
        """The record so far."""
        depth, force, sd = np.array(self._samples).reshape(-1, 3).T
        return DrillingRecord(depth, force, tuple(self._events), sd if np.isfinite(sd).all() else None)
