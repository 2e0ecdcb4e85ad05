"""Images without identity, after DICOM PS3.15, annex E, basic application level confidentiality profile.

The profile's table says of some 600 elements what becomes of them. Here none of them is carried over: a new file is
made of the pixels and five numbers of geometry, so that what nobody thought of stays behind as well.
"""

from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

from pydicom import Dataset, dcmread, dcmwrite
from pydicom.sequence import Sequence
from pydicom.uid import generate_uid

from sightline import __version__
from sightline.atomic import scratch_folder
from sightline.bounded import regular_file
from sightline.imaging import read_image, write_dicom
from sightline.imaging.dicom import quiet
from sightline.imaging.headers import damaged

NOBODY = "REMOVED"
_UIDS = ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID")
_METHOD = ("113100", "DCM", "Basic Application Confidentiality Profile")  # PS3.16, CID 7050


@dataclass(frozen=True)
class Deidentified:
    """The bytes of a DICOM file; whether its source says that text is burnt into the pixels, None where it says
    nothing; and whether such marks were found (`imaging.burnt_in`, which does not find all)."""

    data: bytes
    burnt_in_stated: bool | None
    burnt_in_found: bool


@dataclass
class Deidentifier:
    """For images that belong together: what was one study or series stays one, under a new UID drawn at random."""

    _uids: dict[str, str] = field(default_factory=dict)

    def clean(self, file: Path, frame_index: int | None = None) -> Deidentified:
        """A file of one image as `read_image` reads it: brighter is more X-rays, no window, no table, uncompressed.

        Text that is burnt into the pixels stays: a person must look. Raises ImageError.
        """
        image = read_image(file, frame_index)
        source = _source(file)
        with scratch_folder() as place:
            out = dcmread(write_dicom(image, place / "image.dcm"))
        for keyword in _UIDS:
            setattr(out, keyword, self._uid(source[keyword]))
        out.PatientName = out.PatientID = NOBODY
        out.StudyID = None
        out.DeidentificationMethod = f"PS3.15 basic profile, Sightline {__version__}"
        out.DeidentificationMethodCodeSequence = Sequence([_code(*_METHOD)])
        out.LongitudinalTemporalInformationModified = "REMOVED"
        stated, found = source["BurnedInAnnotation"], image.burnt_in is not None
        if found or stated is not None:
            out.BurnedInAnnotation = "YES" if found or stated else "NO"
        buffer = BytesIO()
        dcmwrite(buffer, out, enforce_file_format=True)
        return Deidentified(buffer.getvalue(), stated, found)

    def _uid(self, old: str | None) -> str:
        """Random, so that nobody who has the original can tell by the UID; where there was none, one of its own."""
        if not old:
            return generate_uid()
        return self._uids.setdefault(old, generate_uid())


def _source(file: Path) -> dict[str, Any]:
    """UIDs, which tell what belongs together, and what is said of burnt-in text; None each where there is nothing."""
    with regular_file(file) as stream:
        is_dicom = stream.read(132)[128:] == b"DICM"
    if not is_dicom:
        return dict.fromkeys([*_UIDS, "BurnedInAnnotation"])
    try:
        with quiet():
            elements = dcmread(file, stop_before_pixels=True, specific_tags=[*_UIDS, "BurnedInAnnotation"])
            texts = {keyword: str(elements.get(keyword) or "") or None for keyword in (*_UIDS, "BurnedInAnnotation")}
    except Exception:  # as in `imaging.dicom`: a message of pydicom's may quote the patient
        raise damaged(file.name) from None
    return {**texts, "BurnedInAnnotation": {"YES": True, "NO": False}.get(texts["BurnedInAnnotation"] or "")}


def _code(value: str, scheme: str, meaning: str) -> Dataset:
    out = Dataset()
    out.CodeValue, out.CodingSchemeDesignator, out.CodeMeaning = value, scheme, meaning
    return out
