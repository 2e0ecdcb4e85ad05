"""Synchronised point-to-point motion: all joints start and stop together, on a straight path in joint space."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.errors import UnusableInputError


@dataclass(frozen=True, eq=False)
class Move:
    """Motion from `start` to `end` (5,), mm and rad, beginning at `begun_s`, with a trapezoidal velocity profile. No
    joint exceeds `speed` or `acceleration` (5,); the slowest joint sets the duration."""

    start: np.ndarray
    end: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    begun_s: float

    def __post_init__(self) -> None:
        if not all(np.isfinite(part).all() for part in (self.start, self.end, self.speed, self.acceleration)):
            raise UnusableInputError("a motion needs finite positions, speeds and accelerations")

    @property
    def duration_s(self) -> float:
        """Duration from rest to rest."""
        return 2 * self._rise_s + self._level_s

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions (5,) and velocities (5,); at rest before the beginning and after the end."""
        if self._rise_s == 0:
            return self.end, np.zeros_like(self.end)
        t = min(max(time_s - self.begun_s, 0.0), self.duration_s)
        left = self.duration_s - t
        peak = self._share_acceleration * self._rise_s
        if t < self._rise_s:
            share, pace = self._share_acceleration * t**2 / 2, self._share_acceleration * t
        elif left < self._rise_s:
            share, pace = 1 - self._share_acceleration * left**2 / 2, self._share_acceleration * left
        else:
            share, pace = peak * (t - self._rise_s / 2), peak
        return self.start + share * self._path, pace * self._path

    @cached_property
    def _path(self) -> np.ndarray:
        return self.end - self.start

    @cached_property
    def _share_acceleration(self) -> float:
        """Acceleration as a share of the whole path, 1/s²."""
        moving = self._path != 0
        return float(np.min((self.acceleration / np.abs(np.where(moving, self._path, 1.0)))[moving], initial=np.inf))

    @cached_property
    def _rise_s(self) -> float:
        moving = self._path != 0
        if not moving.any():
            return 0.0
        pace = float(np.min(self.speed[moving] / np.abs(self._path[moving])))
        return float(min(pace / self._share_acceleration, 1 / np.sqrt(self._share_acceleration)))

    @cached_property
    def _level_s(self) -> float:
        if self._rise_s == 0:
            return 0.0
        peak = self._share_acceleration * self._rise_s
        return max(1 / peak - self._rise_s, 0.0)
