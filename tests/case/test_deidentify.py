"""Images without identity: whatever a header holds, and wherever, nothing of it is in the file that is written."""

from datetime import date
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydicom import Dataset, dcmread, dcmwrite
from pydicom.datadict import keyword_for_tag
from pydicom.sequence import Sequence
from pydicom.uid import generate_uid

from sightline.case.deidentify import Deidentifier
from sightline.imaging import GeometryTags, Radiograph, read_image, write_dicom


def _names(text: str) -> list[str]:
    return text.split()


TAGS = GeometryTags(1000.0, (0.2, 0.2), 310.0, 1.5, -2.0)
# All that a clean file holds, whatever the source held. None of them but UIDs, pixels and geometry follows the source.
ELEMENTS = _names(
    """ImageType SOPClassUID SOPInstanceUID StudyDate StudyTime AccessionNumber Modality Manufacturer
    ReferringPhysicianName PatientName PatientID PatientBirthDate PatientSex PatientIdentityRemoved
    DeidentificationMethod DeidentificationMethodCodeSequence KVP DistanceSourceToDetector ExposureTime
    XRayTubeCurrent RadiationSetting IntensifierSize ImagerPixelSpacing PositionerMotion PositionerPrimaryAngle
    PositionerSecondaryAngle StudyInstanceUID SeriesInstanceUID StudyID SeriesNumber InstanceNumber PatientOrientation
    Laterality SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit
    PixelRepresentation
    PixelIntensityRelationship LossyImageCompression LongitudinalTemporalInformationModified PixelData"""
)
# Elements that hold people, places, times, devices: of PS3.15, table E.1-1, those that X-ray images have.
TEXTS = _names(
    """PatientName PatientID IssuerOfPatientID OtherPatientIDs OtherPatientNames PatientBirthName
    PatientMotherBirthName PatientAddress PatientComments EthnicGroup Occupation AdditionalPatientHistory
    MedicalRecordLocator CountryOfResidence PatientTelephoneNumbers ReferringPhysicianName ReferringPhysicianAddress
    PerformingPhysicianName NameOfPhysiciansReadingStudy PhysiciansOfRecord OperatorsName RequestingPhysician
    ResponsiblePerson InstitutionName InstitutionAddress InstitutionalDepartmentName StationName
    StudyDescription SeriesDescription ImageComments DerivationDescription ProtocolName AcquisitionComments
    AccessionNumber StudyID AdmissionID RequestedProcedureID PerformedProcedureStepID ScheduledProcedureStepID
    DeviceSerialNumber DetectorID PlateID CassetteID GantryID GeneratorID Manufacturer ManufacturerModelName
    SoftwareVersions AdmittingDiagnosesDescription ReasonForStudy StudyComments VisitComments CurrentPatientLocation
    FrameComments ContentCreatorName DeidentificationMethod TextComments"""
)
DATES = _names(
    """StudyDate SeriesDate AcquisitionDate ContentDate PatientBirthDate InstanceCreationDate DateOfLastCalibration
    PerformedProcedureStepStartDate OverlayDate CurveDate AdmittingDate ScheduledProcedureStepStartDate"""
)
UIDS = _names(
    """StudyInstanceUID SeriesInstanceUID SOPInstanceUID FrameOfReferenceUID DeviceUID IrradiationEventUID
    InstanceCreatorUID"""
)

# Long and odd enough not to be in any file by chance.
identifiers = st.text(st.sampled_from("ABCDEFGHJKLMNPQRSTUVWXYZ"), min_size=9, max_size=14).map("q{}q".format)


def image(seed: int = 1) -> Radiograph:
    pixels = np.random.default_rng(seed).integers(300, 3900, (24, 32)).astype(np.uint16)
    return Radiograph(pixels, 4095.0, TAGS)


def source(folder: Path, fill, picture: Radiograph | None = None) -> Path:
    """An image as the twin writes it, with a header that `fill` changed."""
    data = dcmread(write_dicom(picture or image(), folder / "plain.dcm"))
    fill(data)
    dcmwrite(folder / "MILLER_ANNA.dcm", data)
    return folder / "MILLER_ANNA.dcm"


def identified(folder: Path, words: list[str], day: str) -> tuple[Path, list[str]]:
    """Identifiers everywhere that a file has a place for one; and those that are in it."""
    uids = [str(generate_uid()) for _ in UIDS]

    def fill(data: Dataset) -> None:
        for k, keyword in enumerate(TEXTS):
            setattr(data, keyword, words[k % len(words)])
        for keyword in DATES:
            setattr(data, keyword, day)
        for keyword, uid in zip(UIDS, uids, strict=True):
            setattr(data, keyword, uid)
        data.ImageType = ["ORIGINAL", "PRIMARY", words[0].upper()]
        inner, outer = Dataset(), Dataset()
        inner.PatientName, inner.PersonName = words[1], words[2]
        inner.ReferencedSOPInstanceUID = uids[0]
        outer.RequestedProcedureDescription, outer.ContentSequence = words[3], Sequence([inner])
        data.RequestAttributesSequence = Sequence([outer])
        data.add_new(0x00091001, "LO", words[4])  # private, without and with its creator
        block = data.private_block(0x0029, "MAKER " + words[5][:9], create=True)
        block.add_new(1, "UN", words[5].encode())
        block.add_new(2, "SQ", Sequence([inner]))
        data.add_new(0x60000010, "US", 24)
        data.add_new(0x60000011, "US", 32)
        data.add_new(0x60003000, "OW", (words[6] * 8).encode()[:96])  # an overlay's bits
        data.add_new(0x60004000, "LT", words[6])
        data.add_new(0x50003000, "OW", (words[7] * 2).encode())  # a curve
        data.add_new(0x50000030, "SH", words[7])
        data.add_new(0xFFFCFFFC, "OB", words[0].encode())  # padding at the end
        data.PixelData = data.PixelData + words[1].encode()  # behind the last pixel
        data.preamble = words[2].encode().ljust(128, b"\0")
        data.file_meta.SourceApplicationEntityTitle = words[3]
        data.file_meta.PrivateInformationCreatorUID = uids[1]
        data.file_meta.PrivateInformation = words[4].encode()

    file = source(folder, fill)
    raw = file.read_bytes()
    present = [word for word in [*words[:8], day, *uids] if word.encode() in raw]
    assert len(present) == 8 + 1 + len(UIDS)
    return file, present


def elements(data: bytes) -> dict[str, object]:
    return {keyword_for_tag(e.tag) or str(e.tag): e.value for e in dcmread(BytesIO(data))}


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    words=st.lists(identifiers, min_size=8, max_size=20, unique=True),
    day=st.dates(min_value=date(1901, 1, 1)).map("{:%Y%m%d}".format),
)
def test_no_identifier_survives_anywhere_in_the_bytes(tmp_path: Path, words: list[str], day: str) -> None:
    file, present = identified(tmp_path, words, day)
    cleaned = Deidentifier().clean(file).data
    for word in present:
        inner = word if word.isdigit() else word[1:-1]  # six digits of a day stand in a new UID by chance
        for text in (word, word.upper(), word.lower(), inner):
            for encoding in ("utf-8", "utf-16-le", "utf-16-be"):
                assert text.encode(encoding) not in cleaned
    assert set(elements(cleaned)) == set(ELEMENTS)


def test_pixels_and_geometry_are_kept_to_the_bit(tmp_path: Path) -> None:
    file, _ = identified(tmp_path, [f"qIDENTIFIER{c}q" for c in "ABCDEFGH"], "19610203")
    out = tmp_path / "out.dcm"
    out.write_bytes(Deidentifier().clean(file).data)
    found, before = read_image(out), read_image(file)
    np.testing.assert_array_equal(found.pixels, before.pixels)
    assert (found.pixels.dtype, found.white, found.tags) == (before.pixels.dtype, before.white, before.tags)
    np.testing.assert_array_equal(found.pixels, image().pixels)
    assert found.tags == TAGS


def test_the_file_says_what_was_done_to_it(tmp_path: Path) -> None:
    file, _ = identified(tmp_path, [f"qIDENTIFIER{c}q" for c in "ABCDEFGH"], "19610203")
    found = dcmread(BytesIO(Deidentifier().clean(file).data))
    assert found.PatientIdentityRemoved == "YES"
    assert "PS3.15" in found.DeidentificationMethod
    (code,) = found.DeidentificationMethodCodeSequence
    assert (code.CodeValue, code.CodingSchemeDesignator) == ("113100", "DCM")
    assert found.LongitudinalTemporalInformationModified == "REMOVED"
    assert (found.PatientName, found.PatientID) == ("REMOVED", "REMOVED")
    assert found.preamble == bytes(128)
    assert found.file_meta.MediaStorageSOPInstanceUID == found.SOPInstanceUID
    assert set(found.file_meta.keys()) >= {0x00020010}
    assert "SourceApplicationEntityTitle" not in found.file_meta
    for keyword in ("StudyDate", "StudyTime", "PatientBirthDate", "PatientSex", "AccessionNumber", "StudyID"):
        assert not found[keyword].value


def test_images_of_one_study_stay_one_study_under_a_new_uid(tmp_path: Path) -> None:
    study, series = generate_uid(), [generate_uid(), generate_uid()]
    files = []
    for k in range(3):
        folder = tmp_path / str(k)
        folder.mkdir()

        def fill(data: Dataset, k: int = k) -> None:
            data.StudyInstanceUID, data.SeriesInstanceUID = (study if k < 2 else generate_uid()), series[min(k, 1)]
            data.SOPInstanceUID = generate_uid()

        files.append(source(folder, fill))
    cleaner = Deidentifier()
    one, two, other = (dcmread(BytesIO(cleaner.clean(file).data)) for file in files)
    assert one.StudyInstanceUID == two.StudyInstanceUID != other.StudyInstanceUID
    assert two.SeriesInstanceUID == other.SeriesInstanceUID != one.SeriesInstanceUID
    assert len({one.SOPInstanceUID, two.SOPInstanceUID, other.SOPInstanceUID}) == 3
    assert study not in (one.StudyInstanceUID, two.StudyInstanceUID)
    again = dcmread(BytesIO(Deidentifier().clean(files[0]).data))
    assert again.StudyInstanceUID != one.StudyInstanceUID  # another run: nobody can tell that it is the same


@pytest.mark.parametrize(("stated", "told"), [("YES", True), ("NO", False), (None, None), ("MILLER", None)])
def test_what_a_file_says_of_burnt_in_text_is_kept_and_told(tmp_path: Path, stated: str | None, told) -> None:
    def fill(data: Dataset) -> None:
        if stated:
            data.BurnedInAnnotation = stated

    cleaned = Deidentifier().clean(source(tmp_path, fill))
    assert cleaned.burnt_in_stated is told
    assert dcmread(BytesIO(cleaned.data)).get("BurnedInAnnotation") == {True: "YES", False: "NO", None: None}[told]


def test_an_overlay_in_the_unused_bits_of_the_pixels_stays_behind(tmp_path: Path) -> None:
    def fill(data: Dataset) -> None:
        pixels = np.frombuffer(data.PixelData, np.uint16).copy()
        pixels[7::3] |= 1 << 14
        data.PixelData = pixels.tobytes()

    found = dcmread(BytesIO(Deidentifier().clean(source(tmp_path, fill)).data))
    np.testing.assert_array_equal(np.frombuffer(found.PixelData, np.uint16), image().pixels.ravel())


def test_an_image_that_is_no_dicom_file_is_made_one(tmp_path: Path) -> None:
    picture = image()
    np.save(tmp_path / "a.npy", picture.pixels)
    found = dcmread(BytesIO(Deidentifier().clean(tmp_path / "a.npy").data))
    assert found.PatientIdentityRemoved == "YES"
    assert set(elements(Deidentifier().clean(tmp_path / "a.npy").data)) == set(ELEMENTS)
