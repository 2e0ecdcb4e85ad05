"""De-identified images, after DICOM PS3.15, annex E, basic application level confidentiality profile.

The profile lists about 600 elements to remove, replace or keep. Here no element is copied: a new file is written from
the pixels and five numbers of geometry, so that elements missing from the list are removed as well.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydicom import Dataset, dcmread
from pydicom.uid import generate_uid

from sightline import __version__
from sightline.common.atomic import scratch_folder
from sightline.imaging import read_image, write_dicom
from sightline.imaging.bare import complete
from sightline.imaging.dicom import file_bytes, fill, quiet
from sightline.imaging.formats import ReadBy, damaged, format_of_file

NOBODY = "REMOVED"
_UIDS = ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID")
_METHOD = ("113100", "DCM", "Basic Application Confidentiality Profile")  # PS3.16, CID 7050


@dataclass(frozen=True)
class Deidentified:
    """The bytes of a de-identified DICOM file.

    `burnt_in_stated`: whether the source states burnt-in annotation; None where it states nothing. `burnt_in_found`:
    whether `imaging.burnt_in` found any; it does not find all.
    """

    data: bytes
    burnt_in_stated: bool | None
    burnt_in_found: bool


@dataclass
class Deidentifier:
    """De-identifies images that belong together: images of one study or series share a new random UID."""

    _uids: dict[str, str] = field(default_factory=dict)

    def clean(self, file: Path, frame_index: int | None = None) -> Deidentified:
        """Return one image as a new file. Its pixels are those of `read_image`: uncompressed, brighter means more
        X-rays, without window or lookup table.

        Burnt-in annotation stays in the pixels: a person must look at the image. Raises ImageError.
        """
        image = read_image(file, frame_index)
        source = _source(file)
        with scratch_folder() as place:
            dataset = dcmread(write_dicom(image, place / "image.dcm"))
        stated, is_found = source["BurnedInAnnotation"], image.burnt_in is not None
        # Random, so that none can be traced to its original; an image without a UID gets one of its own.
        uids = {keyword: self._uids.setdefault(source[keyword] or generate_uid(), generate_uid()) for keyword in _UIDS}
        value, scheme, meaning = _METHOD
        method = fill(Dataset(), CodeValue=value, CodingSchemeDesignator=scheme, CodeMeaning=meaning)
        fill(
            dataset,
            **uids,
            PatientName=NOBODY,
            PatientID=NOBODY,
            StudyID=None,
            DeidentificationMethod=f"PS3.15 basic profile, Sightline {__version__}",
            DeidentificationMethodCodeSequence=[method],
            LongitudinalTemporalInformationModified="REMOVED",
        )
        if is_found or stated is not None:
            dataset.BurnedInAnnotation = "YES" if is_found or stated else "NO"
        return Deidentified(file_bytes(dataset), stated, is_found)


def _source(file: Path) -> dict[str, Any]:
    """Return the source's UIDs and whether it states burnt-in annotation; None for each that is missing."""
    known = format_of_file(file)
    if known is None or known.reader is not ReadBy.DICOM:
        return dict.fromkeys([*_UIDS, "BurnedInAnnotation"])
    try:
        with quiet(), complete(file) as whole:
            elements = dcmread(whole, stop_before_pixels=True, specific_tags=[*_UIDS, "BurnedInAnnotation"])
            texts = {keyword: str(elements.get(keyword) or "") or None for keyword in (*_UIDS, "BurnedInAnnotation")}
    except Exception:  # as in `imaging.dicom`: pydicom's messages may quote the patient
        raise damaged(file.name) from None
    return {**texts, "BurnedInAnnotation": {"YES": True, "NO": False}.get(texts["BurnedInAnnotation"] or "")}
