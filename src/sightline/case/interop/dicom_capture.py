"""An image as a DICOM secondary capture."""

import numpy as np
from pydicom import Dataset
from pydicom.uid import SecondaryCaptureImageStorage

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.dicom_parts import ExportIdentity, dataset
from sightline.errors import UnusableInputError


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
