"""Images of a rehearsed patient, made in the worker process and returned as file bytes.

Only that process imports the twin, so that the first page does not wait for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from sightline.atomic import scratch_folder
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.imaging import Radiograph, write_dicom

if TYPE_CHECKING:
    from sightline.rehearsal.rehearsal import Rehearsal


@dataclass(frozen=True)
class Patient:
    """The simulated patient of a rehearsal: `Rehearsal.draw(seed, Frame.load(frame), side)`."""

    seed: int
    frame: str = "gamma"
    side: str = "right"

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Patient":
        """Return the patient from JSON types."""
        return Patient(int(document["seed"]), str(document["frame"]), str(document["side"]))


@lru_cache(maxsize=1)
def rehearsal_of(patient: Patient) -> "Rehearsal":
    """Return the patient's rehearsal, drawn once in a process."""
    from sightline.rehearsal.rehearsal import Rehearsal

    return Rehearsal.draw(patient.seed, Frame.load(patient.frame), patient.side)


def images(patient: Patient) -> dict[str, bytes]:
    """Return the planning images as DICOM, by view."""
    return _files(rehearsal_of(patient).images, patient)


def check_images(patient: Patient, wires: Mapping[str, str]) -> dict[str, bytes]:
    """Return the check images as DICOM, by view, with the wires (`SimulatedWire.text`) in the bone, by kind."""
    from sightline.robot.link.simulated import SimulatedWire

    *_, newest = map(SimulatedWire.of, wires.values())
    return _files(rehearsal_of(patient).check_images(newest).images, patient)


def _files(radiographs: Mapping[str, Radiograph], patient: Patient) -> dict[str, bytes]:
    with scratch_folder() as folder:
        written = {name: write_dicom(radiographs[name], folder / f"{name}.dcm", patient.side) for name in NAMES}
        return {name: file.read_bytes() for name, file in written.items()}
