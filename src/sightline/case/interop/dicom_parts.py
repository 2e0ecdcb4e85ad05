"""The parts that all DICOM objects of an export share. The patient is named by the case number only."""

import re
from dataclasses import dataclass
from datetime import datetime
from io import BytesIO
from typing import Literal

from pydicom import Dataset, dcmwrite
from pydicom.dataset import FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

from sightline import __version__
from sightline.errors import UnusableInputError

_SERIES = {"OT": 1, "PR": 2}  # images, presentation states


@dataclass(frozen=True)
class ExportIdentity:
    """Identity of an export: case number, time of creation, the patient's side where known. Equal identities give equal
    UIDs."""

    case: str
    created: datetime
    side: Literal["left", "right"] | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,16}", self.case):
            raise UnusableInputError(
                f"--case {self.case[:40]!r} is not a case number: give 1 to 16 letters, digits or _ . - , and no name"
            )

    def uid(self, *parts: str) -> str:
        """Return the UID of one part of the export."""
        return str(generate_uid(entropy_srcs=[self.case, self.created.isoformat(), *parts]))


def dataset(
    identity: ExportIdentity, sop_class: str, modality: str, part: str, study_uid: str | None = None
) -> Dataset:
    """Return the modules patient, study, series, equipment and SOP common.

    Without `study_uid` the object belongs to a study of the export's own.
    """
    out = Dataset()
    out.SOPClassUID, out.SOPInstanceUID = sop_class, identity.uid("instance", part)
    out.StudyInstanceUID = study_uid or identity.uid("study")
    out.SeriesInstanceUID = identity.uid("series", modality, out.StudyInstanceUID)
    out.SpecificCharacterSet = "ISO_IR 192"
    out.PatientName = out.PatientID = identity.case
    for empty in ("PatientBirthDate", "PatientSex", "ReferringPhysicianName", "AccessionNumber"):
        setattr(out, empty, None)
    if study_uid in (None, identity.uid("study")):
        out.StudyDate, out.StudyTime = f"{identity.created:%Y%m%d}", f"{identity.created:%H%M%S}"
        out.StudyID = identity.case
    else:  # the study of the original image, of which only the UIDs were read
        out.StudyDate = out.StudyTime = out.StudyID = None
    out.PatientIdentityRemoved, out.DeidentificationMethod = "YES", "Only the case number is written"
    out.Modality, out.SeriesNumber, out.Manufacturer = modality, _SERIES[modality], "Sightline"
    out.Laterality = None if identity.side is None else identity.side[0].upper()
    out.SoftwareVersions = __version__
    return out


def file_bytes(out: Dataset) -> bytes:
    """Return a DICOM file's bytes, explicit VR little endian."""
    out.file_meta = FileMetaDataset()
    out.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    buffer = BytesIO()
    dcmwrite(buffer, out, enforce_file_format=True)
    return buffer.getvalue()
