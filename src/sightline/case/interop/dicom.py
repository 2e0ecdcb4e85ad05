"""DICOM objects of an export: the modules they share, and an image as a secondary capture. The case number names the
patient."""

import re
from dataclasses import dataclass
from datetime import datetime
from io import BytesIO
from typing import Literal

import numpy as np
from pydicom import Dataset, dcmwrite
from pydicom.dataset import FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, SecondaryCaptureImageStorage, generate_uid

from sightline import __version__
from sightline.calibration.exchange.pinhole import Pinhole
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


def capture(
    image: tuple[np.ndarray, float], pinhole: Pinhole, identity: ExportIdentity, comment: str, number: int
) -> Dataset:
    """Return an image as a secondary capture: pixels (H, W), uint8 or uint16, and their white value.

    The stated pixel size is that on the plate. Raises UnusableInputError for other types of pixels.
    """
    pixels, white = image
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.shape != pinhole.shape:
        raise UnusableInputError("DICOM holds whole numbers of 8 or 16 bits; give images with such pixels")
    bits = 8 * pixels.itemsize
    _, across, down = pinhole.detector_mm()
    out = dataset(identity, SecondaryCaptureImageStorage, "OT", f"{pinhole.name} {number}")
    out.ConversionType, out.InstanceNumber, out.PatientOrientation = "WSD", number, None
    out.ImageType, out.BurnedInAnnotation = ["DERIVED", "SECONDARY"], "NO"
    out.SeriesDescription = "Sightline"
    out.ImageComments = comment[:10240]
    out.DerivationDescription = "Resampled to the plane of the XRII plate: distortion removed"
    out.SamplesPerPixel, out.PhotometricInterpretation, out.PixelRepresentation = 1, "MONOCHROME2", 0
    out.Rows, out.Columns = pixels.shape
    out.BitsAllocated = out.BitsStored = bits
    out.HighBit = bits - 1
    top = min(float(white), 2.0**bits - 1)
    out.WindowCenter, out.WindowWidth = [f"{0.5 * (top + 1):.10g}"], [f"{top + 1:.10g}"]
    out.PixelSpacing = [f"{down:.10g}", f"{across:.10g}"]
    out.PixelSpacingCalibrationType = "FIDUCIAL"
    out.PixelSpacingCalibrationDescription = "mm in the plane of the XRII plate"
    raw = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()
    out.PixelData = raw + b"\0" * (len(raw) % 2)
    out["PixelData"].VR = "OW" if bits == 16 else "OB"
    return out
