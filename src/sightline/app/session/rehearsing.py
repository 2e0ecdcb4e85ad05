"""Images of a rehearsed patient, made in the worker process and returned as file bytes.

Only that process imports the twin, so that the first page does not wait for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sightline.case.views import NAMES, OBLIQUE
from sightline.common.atomic import scratch_folder
from sightline.frame import Frame
from sightline.imaging import Radiograph, write_dicom
from sightline.planning import Nail
from sightline.planning.procedures import kind as kind_of

if TYPE_CHECKING:
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.kinematics.designs import Design
    from sightline.robot.link.record import SimulatedWire


HIP, NAIL = "hip", "nail"  # what a patient has who is of a procedure at the hip; what a procedure through holes needs


@dataclass(frozen=True)
class Patient:
    """The simulated patient of a rehearsal: `Rehearsal.draw(seed, Frame.load(frame), side, procedure, arm)`."""

    seed: int
    frame: str = "gamma"
    side: str = "right"
    procedure: str = "hip-screw"
    arm: "Design" = "manipulator"

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Patient":
        """Return the patient from JSON types; earlier versions knew those of a hip screw, and one arm, only."""
        return Patient(**{key: document[key] for key in Patient.__match_args__ if key in document})


@lru_cache(maxsize=1)
def rehearsal_of(patient: Patient) -> "Rehearsal":
    """Return the patient's rehearsal, drawn once in a process."""
    from sightline.rehearsal.rehearsal import Rehearsal

    return Rehearsal.draw(patient.seed, Frame.load(patient.frame), patient.side, patient.procedure, patient.arm)


def images(patient: Patient, names: Sequence[str] = NAMES) -> dict[str, bytes]:
    """Return planning images as DICOM, by view; of a block also the oblique one."""
    rehearsal = rehearsal_of(patient)
    taken = {name: rehearsal.oblique_image() if name == OBLIQUE else rehearsal.images[name] for name in names}
    return _files(taken, patient)


def lacking_in(patient: Patient) -> dict[str, str]:
    """Return what a patient lacks for the procedures that need another bone: HIP, NAIL, or the bone's name in the twin,
    by their keys."""
    from sightline.rehearsal.patient import BONE_OF, CANNULATED, NAILED

    needed = {"hip-screw": HIP, CANNULATED: HIP, NAILED: NAIL, **BONE_OF}
    own = needed.get(patient.procedure, HIP)
    return {key: what for key, what in needed.items() if what != own}


def nail_of(patient: Patient) -> Nail | None:
    """Return the nail that the patient has, as its maker states it; None without one."""
    return rehearsal_of(patient).nail


def shot_images(
    patient: Patient, wires: Mapping[str, str], q: Sequence[float], state: str, on_patient: bool = False
) -> dict[str, bytes]:
    """Return both images while drilling, with the robot waiting in a state at its joints `q` (n,); `wires` as of
    `check_images`, the one that is drilled last. `on_patient`: the frame is fixed to the patient."""
    rehearsal, newest, key, before_mm = _in_bone(patient, wires)
    taken = rehearsal.drilling_images(newest, np.array(q), state, key, before_mm, on_patient=on_patient)
    return _files(taken.images, patient)


def check_images(patient: Patient, wires: Mapping[str, str], retake: int = 0) -> dict[str, bytes]:
    """Return the check images as DICOM, by view, with the wires (`SimulatedWire.text`) in the bone, by kind.

    `retake`: how often they were taken before.
    """
    rehearsal, newest, key, before_mm = _in_bone(patient, wires)
    return _files(rehearsal.check_images(newest, key, before_mm, retake=retake).images, patient)


def _in_bone(
    patient: Patient, wires: Mapping[str, str]
) -> "tuple[Rehearsal, SimulatedWire, str, dict[str, np.ndarray]]":
    """Return the rehearsal of the procedure, the newest wire and its key, and the axes (2, 3) of the others by key."""
    from sightline.robot.link.record import SimulatedWire

    *before, (kind, newest) = [(kind_of(kind), SimulatedWire.of(text)) for kind, text in wires.items()]
    rehearsal = replace(rehearsal_of(patient), procedure=kind.document.key)
    return rehearsal, newest, kind.wire.key, {earlier.wire.key: wire.axis_mm for earlier, wire in before}


def _files(radiographs: Mapping[str, Radiograph], patient: Patient) -> dict[str, bytes]:
    with scratch_folder() as folder:
        written = {
            name: write_dicom(radiograph, folder / f"{name}.dcm", patient.side)
            for name, radiograph in radiographs.items()
        }
        return {name: file.read_bytes() for name, file in written.items()}
