"""A registered bone as the journal keeps it, and as plans take it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pydantic import TypeAdapter

from sightline.calibration import BeadView
from sightline.common.checks import Check
from sightline.errors import CaseError
from sightline.planning.bone.registered import RegisteredBone

Line = list[list[float]]  # of [u, v]


@dataclass(frozen=True)
class FoundBone:
    """A registered bone, as the journal keeps it. `images`: numbers of the entries that acquired the images, by their
    names; `pose`: as of `BonePose.document`; `error`: its 95 % error as a sentence; `checks`: its own, without those
    of the views; `edges`: of the bone's shadow in each image, lines of px."""

    images: Mapping[str, int]
    pose: Mapping[str, Any]
    error: str
    checks: tuple[Mapping[str, Any], ...]
    edges: Mapping[str, list[Line]]

    @property
    def judged(self) -> tuple[Check, ...]:
        """The checks."""
        return tuple(map(Check.of, self.checks))

    @cached_property
    def registered(self) -> RegisteredBone:
        """The bone, as plans take it."""
        return RegisteredBone.of(self.pose)

    def document(self) -> dict[str, Any]:
        """Return it as JSON types."""
        return _JSON.dump_python(self, mode="json")

    @staticmethod
    def of(document: Any) -> "FoundBone":
        """Return it from JSON types. Raises CaseError."""
        try:
            return _JSON.validate_python(document)
        except ValueError as error:
            raise CaseError(
                "the bone's pose in the case's journal cannot be read; run `sightline case check`"
            ) from error


_JSON = TypeAdapter(FoundBone)


@dataclass(frozen=True, eq=False)
class BoneInViews:
    """An accepted bone, and the views, calibrated one by one, that it was registered to."""

    bone: RegisteredBone
    views: tuple[BeadView, ...]
