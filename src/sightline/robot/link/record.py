"""Record of drilling, with depth, force and events as sent over the link; and the true wire that a simulator sends."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from json import JSONDecodeError, dumps, loads
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError
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

    @property
    def continues(self) -> bool:
        """Whether it is of a hole that was begun before."""
        return any(event.name == contract.OPEN_HOLE for event in self.events)

    def after(self, before: "DrillingRecord") -> "DrillingRecord":
        """Return the record of both parts of a hole."""
        (depth, sd, force), (depth_2, sd_2, force_2) = (
            (part.depth_mm, part.depth_sd_mm, part.force_n) for part in (before, self)
        )
        both_sd = None if sd is None or sd_2 is None else np.append(sd, sd_2)
        return DrillingRecord(
            np.append(depth, depth_2), np.append(force, force_2), before.events + self.events, both_sd
        )

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


def last_hole(records: Sequence[DrillingRecord]) -> DrillingRecord | None:
    """Return the record of the last hole, with all its parts where it was drilled in several."""
    hole = None
    for record in records:
        hole = record.after(hole) if hole is not None and record.continues else record
    return hole


_STANDS_MM = 0.005  # [ours] half of a sample's way at the slowest feed


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
                self._add(value)
        elif isinstance(body, String) and message.device_name == contract.EVENT:
            match = _EVENT.fullmatch(body.text)
            if match is not None:
                self._events.append(DrillingEvent(match[1], float(match[2]), float(match[3])))

    def _add(self, depth_mm: float) -> None:
        """Add a sample; of a wire that stands only the one with the largest force, however long a person thinks."""
        last_mm, last_n, _ = self._samples[-1] if self._samples else (np.inf, 0.0, 0.0)
        if abs(depth_mm - last_mm) < _STANDS_MM:
            self._samples[-1] = (last_mm, max(self._force_n, last_n), self._sd_mm)
        else:
            self._samples.append((depth_mm, self._force_n, self._sd_mm))

    @property
    def record(self) -> DrillingRecord:
        """The record so far."""
        depth, force, sd = np.array(self._samples).reshape(-1, 3).T
        return DrillingRecord(depth, force, tuple(self._events), sd if np.isfinite(sd).all() else None)


@dataclass(frozen=True, eq=False)
class SimulatedWire:
    """`wire_mm` (3, 3) MCS: current points of the wire's axis at the guide's mouth, at the bone (else halfway), and at
    the tip. `T_mcs_cfcs`: true pose of the frame at the images; `imaged` (n,): the encoders then."""

    wire_mm: np.ndarray
    T_mcs_cfcs: RigidTransform
    imaged: np.ndarray

    @property
    def axis_mm(self) -> np.ndarray:
        """(2, 3): where the wire leaves its guide, and its tip, CFCS of the images, mm."""
        return self.T_mcs_cfcs.inv().apply(self.wire_mm[[0, 2]])

    def text(self) -> str:
        """Return the text that the link carries."""
        values = {"wire_mm": self.wire_mm, "T_mcs_cfcs": self.T_mcs_cfcs.as_matrix(), "imaged": self.imaged}
        return dumps({name: value.tolist() for name, value in values.items()})

    @staticmethod
    def of(text: str) -> "SimulatedWire":
        """Return the wire from such a text. Raises UnusableInputError."""
        try:
            values_by_name = loads(text)
            names = ("wire_mm", "T_mcs_cfcs", "imaged")
            wire, frame, imaged = (np.array(values_by_name[name], dtype=np.float64) for name in names)
        except (JSONDecodeError, KeyError, TypeError, ValueError) as error:
            raise UnusableInputError("this text does not describe a simulated wire") from error
        finite = all(np.isfinite(value).all() for value in (wire, frame, imaged))
        if not finite or (wire.shape, frame.shape, imaged.ndim) != ((3, 3), (4, 4), 1):
            raise UnusableInputError("a simulated wire is three finite points, a pose and the joints")
        return SimulatedWire(wire, RigidTransform.from_matrix(frame), imaged)
