"""What the DICOM objects of an export share. Nobody is named: the patient is the case number."""

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
class Filed:
    """Under what an export is filed: case number, when it was made, the patient's side where it is known.

    The same export has the same UIDs.
    """

    case: str
    created: datetime
    side: Literal["left", "right"] | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,16}", self.case):
            raise UnusableInputError(
                f"--case {self.case[:40]!r} is no case number: 1 to 16 letters, digits or _ . - , and no name"
            )

    def uid(self, *parts: str) -> str:
        """A UID for one part of the export."""
        return str(generate_uid(entropy_srcs=[self.case, self.created.isoformat(), *parts]))


def dataset(filed: Filed, sop_class: str, modality: str, part: str, study_uid: str | None = None) -> Dataset:
    """Patient, study, series, equipment and SOP common; a study of the export's own without `study_uid`."""
    out = Dataset()
    out.SOPClassUID, out.SOPInstanceUID = sop_class, filed.uid("instance", part)
    out.StudyInstanceUID = study_uid or filed.uid("study")
    out.SeriesInstanceUID = filed.uid("series", modality, out.StudyInstanceUID)
    out.SpecificCharacterSet = "ISO_IR 192"
    out.PatientName = out.PatientID = filed.case
    for empty in ("PatientBirthDate", "PatientSex", "ReferringPhysicianName", "AccessionNumber"):
        setattr(out, empty, None)
    if study_uid in (None, filed.uid("study")):
        out.StudyDate, out.StudyTime, out.StudyID = f"{filed.created:%Y%m%d}", f"{filed.created:%H%M%S}", filed.case
    else:  # of somebody else's study, of which nothing but its UIDs was read
        out.StudyDate = out.StudyTime = out.StudyID = None
    out.PatientIdentityRemoved, out.DeidentificationMethod = "YES", "Only the case number is written"
    out.Modality, out.SeriesNumber, out.Manufacturer = modality, _SERIES[modality], "Sightline"
    out.Laterality = None if filed.side is None else filed.side[0].upper()
    out.SoftwareVersions = __version__
    return out


def file_bytes(out: Dataset) -> bytes:
    """As a DICOM file, explicit little endian."""
    out.file_meta = FileMetaDataset()
    out.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    buffer = BytesIO()
    dcmwrite(buffer, out, enforce_file_format=True)
    return buffer.getvalue()
