"""The pose of a bone, its error, and what speaks for it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from sightline.common.show import Plotted
from sightline.from_images.registration import pictures
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.movement import Apart
from sightline.from_images.registration.observed import BoneShot
from sightline.planning.bone.registered import RegisteredBone


@dataclass(frozen=True, eq=False, repr=False)
class BonePose(RegisteredBone, Plotted):
    """The pose of a bone, which takes its CT's or mesh's coordinates, mm, to CFCS. Look at `checks` before you use it.

    It is a `RegisteredBone` with what it was found from. `apart`: the views' own poses. `loss`: mean of the differences
    of shadows and images, 0 to 1; it compares poses of one bone in the same images, and nothing else.

    >>> import inspect
    >>> list(inspect.signature(sl.BonePose.covariance_at).parameters)
    ['self', 'xyz_mm']
    """

    apart: Apart = field(metadata={"written": False})
    bone: ScannedBone = field(metadata={"written": False})
    shots: Sequence[BoneShot] = field(metadata={"written": False})
    loss: float = field(metadata={"written": False})

    def _new_axes(self, figure: Any) -> Any:
        return pictures.new_axes(figure, len(self.shots))

    def _size_in(self) -> tuple[float, float]:
        return pictures.size_in(len(self.shots))

    def _draw(self, ax: Any) -> None:
        pictures.draw(ax, self.shots, self.bone, self.pose)
