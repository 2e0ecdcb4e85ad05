"""DICOM files as C-arms and archives write them: every transfer syntax, pixel layout and polarity."""

import logging
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from struct import pack
from threading import Event
from typing import Any

import cv2
import gdcm
import numpy as np
import pydicom
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydicom.encaps import encapsulate, generate_frames
from pydicom.uid import RLELossless
from tests.imaging.transcoding import transcoded

from sightline.errors import ImageError
from sightline.imaging import GeometryTags, Radiograph, as_radiograph, frames_in, read_image, taken_at, write_dicom
from sightline.imaging.dicom import fill
from sightline.imaging.quiet import Quiet

PATIENT = "Doe^Jane^Secret"


def scene(bits: int = 12, shape: tuple[int, int] = (48, 64), seed: int = 1) -> np.ndarray:
    """Return a smooth image with noise that uses all its bits."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    light = 0.5 + 0.45 * np.sin(u / 9.0) * np.cos(v / 7.0)
    noise = np.random.default_rng(seed).normal(0, 0.01, shape)
    values = np.clip((light + noise) * (2**bits - 1), 0, 2**bits - 1)
    return values.astype(np.uint8 if bits == 8 else np.uint16)


def dataset(pixels: np.ndarray, bits: int, tmp_path: Path) -> pydicom.Dataset:
    out = pydicom.dcmread(write_dicom(Radiograph(pixels, 2.0**bits - 1), tmp_path / "base.dcm"))
    out.PatientName = PATIENT
    return out


def saved(out: pydicom.Dataset, tmp_path: Path, name: str = "image.dcm") -> Path:
    out.save_as(tmp_path / name)
    return tmp_path / name


LOSSLESS = {
    "implicit": gdcm.TransferSyntax.ImplicitVRLittleEndian,
    "big endian": gdcm.TransferSyntax.ExplicitVRBigEndian,
    "JPEG lossless": gdcm.TransferSyntax.JPEGLosslessProcess14,
    "JPEG lossless, first order": gdcm.TransferSyntax.JPEGLosslessProcess14_1,
    "JPEG-LS": gdcm.TransferSyntax.JPEGLSLossless,
    "JPEG 2000": gdcm.TransferSyntax.JPEG2000Lossless,
    "RLE": gdcm.TransferSyntax.RLELossless,
}


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("syntax", LOSSLESS)
def test_a_lossless_transfer_syntax_gives_the_pixels_back(tmp_path: Path, bits: int, syntax: str) -> None:
    pixels = scene(bits)
    path = transcoded(saved(dataset(pixels, bits, tmp_path), tmp_path), LOSSLESS[syntax], tmp_path / "coded.dcm")
    image = read_image(path)
    np.testing.assert_array_equal(image.pixels, pixels)
    assert image.white == 2**bits - 1
    assert image.pixels.dtype == pixels.dtype


@pytest.mark.parametrize(
    ("bits", "syntax"),
    [
        (8, gdcm.TransferSyntax.JPEGBaselineProcess1),
        (12, gdcm.TransferSyntax.JPEG2000),
        (12, gdcm.TransferSyntax.JPEGLSNearLossless),
    ],
)
def test_a_lossy_transfer_syntax_gives_nearly_the_pixels_back(tmp_path: Path, bits: int, syntax: int) -> None:
    pixels = scene(bits)
    path = transcoded(saved(dataset(pixels, bits, tmp_path), tmp_path), syntax, tmp_path / "coded.dcm")
    error = read_image(path).pixels.astype(float) - pixels
    assert np.sqrt(np.mean(error**2)) < 0.02 * 2**bits


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_what_is_written_is_valid_and_is_read_again(tmp_path: Path, bits: int) -> None:
    pixels = scene(bits, (33, 47))
    path = write_dicom(Radiograph(pixels, 2.0**bits - 1), tmp_path / "pa.dcm")
    np.testing.assert_array_equal(read_image(path).pixels, pixels)
    header = pydicom.dcmread(path)
    assert (header.BitsStored, header.HighBit, header.Modality) == (bits, bits - 1, "XA")
    for keyword in ("DistanceSourceToDetector", "ImagerPixelSpacing", "IntensifierSize", "PositionerPrimaryAngle"):
        assert header[keyword].is_empty
    assert header.SOPInstanceUID != header.StudyInstanceUID
    np.testing.assert_array_equal(header.pixel_array, pixels)


def test_the_same_image_gives_the_same_file_and_no_other_is_left_behind(tmp_path: Path) -> None:
    image = Radiograph(scene(), 4095.0)
    first, second = (write_dicom(image, tmp_path / name).read_bytes() for name in ("a.dcm", "b.dcm"))
    assert first == second
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.dcm", "b.dcm"]


def test_geometry_tags_are_kept_where_there_are_any(tmp_path: Path) -> None:
    tags = GeometryTags(1000.0, (0.21, 0.22), 230.0, -32.5, 2.0)
    path = write_dicom(Radiograph(scene(), 4095.0, tags), tmp_path / "pa.dcm")
    assert read_image(path).tags == tags


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("DistanceSourceToDetector", "0"),
        ("DistanceSourceToDetector", "-5"),
        ("ImagerPixelSpacing", ["0.2"]),
        ("ImagerPixelSpacing", ["0", "0"]),
        ("PositionerPrimaryAngle", ""),
    ],
)
def test_a_tag_that_says_nothing_is_unknown_not_zero(tmp_path: Path, keyword: str, value: object) -> None:
    out = dataset(scene(), 12, tmp_path)
    setattr(out, keyword, value)
    assert read_image(saved(out, tmp_path)).tags == GeometryTags()


@pytest.mark.parametrize(
    ("photometric", "sign", "slope", "inverted"),
    [
        ("MONOCHROME2", None, None, False),
        ("MONOCHROME1", None, None, True),
        ("MONOCHROME2", None, "-1", True),
        ("MONOCHROME1", None, "-1", False),
        ("MONOCHROME1", 1, None, False),
        ("MONOCHROME1", -1, None, True),
        ("MONOCHROME2", -1, None, True),
    ],
)
def test_brighter_is_more_x_rays(
    tmp_path: Path, photometric: str, sign: int | None, slope: str | None, inverted: bool
) -> None:
    pixels = scene()
    out = dataset(pixels, 12, tmp_path)
    out.PhotometricInterpretation = photometric
    if sign is not None:
        out.PixelIntensityRelationshipSign = sign
    if slope is not None:
        out.RescaleSlope, out.RescaleIntercept = slope, "0"
    image = read_image(saved(out, tmp_path))
    np.testing.assert_array_equal(image.pixels, 4095 - pixels if inverted else pixels)
    assert image.white == 4095


def test_a_window_for_the_eye_does_not_change_the_stored_values(tmp_path: Path) -> None:
    out = dataset(scene(), 12, tmp_path)
    out.WindowCenter, out.WindowWidth, out.RescaleSlope, out.RescaleIntercept = "100", "50", "0.5", "-1024"
    np.testing.assert_array_equal(read_image(saved(out, tmp_path)).pixels, scene())


def _signed(case: str) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Return signed values, those that are read, and bits stored and read."""
    pixels = scene(10).astype(np.int16)
    changed = pixels.copy()
    if case == "one":
        changed[3, 4] = -1
    elif case == "noise about black":
        changed -= 5
    elif case == "edges":
        changed[3, :9] = np.arange(-90, 0, 10)
    elif case == "padding":
        changed[:12] = -2000
        changed[30:] -= 5
    return changed, np.maximum(changed, 0), 16, 15


@pytest.mark.parametrize("case", ["none", "one", "noise about black", "edges", "padding"])
def test_signed_pixels_become_unsigned(tmp_path: Path, case: str) -> None:
    """Zero stays black, whatever is below it."""
    changed, expected, bits, read = _signed(case)
    out = dataset(scene(16), bits, tmp_path)
    out.PixelRepresentation, out.PixelData = 1, changed.tobytes()
    np.save(tmp_path / "image.npy", changed)
    (tmp_path / "image.tif").write_bytes(cv2.imencode(".tiff", changed)[1].tobytes())
    for source in (saved(out, tmp_path), changed, tmp_path / "image.npy", tmp_path / "image.tif"):
        image = as_radiograph(source)
        np.testing.assert_array_equal(image.pixels, expected)
        assert image.white == 2**read - 1
    np.testing.assert_array_equal(as_radiograph(changed.astype(float), 1023.0).pixels, expected)


def test_signed_pixels_that_fill_their_range_begin_at_its_lowest_value_and_others_have_no_black(tmp_path: Path) -> None:
    out = dataset(scene(12), 12, tmp_path)
    out.PixelRepresentation, out.PixelData = 1, (scene(12).astype(np.int16) - 2048).tobytes()
    image = read_image(saved(out, tmp_path))
    np.testing.assert_array_equal(image.pixels, scene(12))
    assert image.white == 4095
    out.PixelData = (scene(10).astype(np.int16) - 512).tobytes()
    with pytest.raises(ImageError, match=r"% of the values of image\.dcm are negative, down to -4"):
        read_image(saved(out, tmp_path))


@pytest.mark.parametrize("signed", [0, 1])
@pytest.mark.parametrize("syntax", ["native", *LOSSLESS])
def test_values_are_read_at_the_bits_where_they_are_stored(tmp_path: Path, syntax: str, signed: int) -> None:
    """12 bits that end at bit 15; compressed values that begin at bit 0 whatever High Bit says, as their codes say."""
    pixels = scene(12) // (1 + signed)
    out = dataset(pixels << 4, 16, tmp_path)
    path = saved(out, tmp_path)
    if syntax != "native":
        path = transcoded(path, LOSSLESS[syntax], tmp_path / "coded.dcm")
    out = pydicom.dcmread(path)
    out.BitsStored, out.HighBit, out.PixelRepresentation = 12, 15, signed
    np.testing.assert_array_equal(read_image(saved(out, tmp_path)).pixels, pixels)
    if "JPEG" in syntax:
        out = pydicom.dcmread(transcoded(saved(dataset(pixels, 12, tmp_path), tmp_path), LOSSLESS[syntax], path))
        out.HighBit = 15
        np.testing.assert_array_equal(read_image(saved(out, tmp_path)).pixels, pixels)


def test_an_overlay_above_the_values_is_not_part_of_them(tmp_path: Path) -> None:
    pixels = scene(12)
    out = dataset(pixels, 12, tmp_path)
    out.PixelData = (pixels | (np.indices(pixels.shape).sum(axis=0) % 9 == 5).astype(np.uint16) << 12).tobytes()
    np.testing.assert_array_equal(read_image(saved(out, tmp_path)).pixels, pixels)


@pytest.mark.parametrize("syntax", ["explicit", "implicit", "big endian"])
@pytest.mark.parametrize("lacks", ["preamble", "preamble and magic", "file meta", "all", "transfer syntax"])
def test_a_file_without_its_first_parts_is_read(tmp_path: Path, lacks: str, syntax: str) -> None:
    out = dataset(scene(), 12, tmp_path)
    out.AcquisitionDateTime = "20260304050607+0000"
    path = saved(out, tmp_path)
    if syntax != "explicit":
        path = transcoded(path, LOSSLESS[syntax], tmp_path / "coded.dcm")
    whole = path.read_bytes()
    meta = 144 + int.from_bytes(whole[140:144], "little")
    at = whole.index(b"\2\0\x10\0UI")
    cut = {
        "preamble": whole[128:],
        "preamble and magic": whole[132:],
        "file meta": whole[:132] + whole[meta:],
        "all": whole[meta:],
        "transfer syntax": whole[:at] + whole[at + 8 + whole[at + 6] :],
    }[lacks]
    (tmp_path / "cut").write_bytes(cut)
    np.testing.assert_array_equal(read_image(tmp_path / "cut").pixels, scene())
    assert (frames_in(tmp_path / "cut"), taken_at(tmp_path / "cut")) == (1, datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC))


def test_compressed_pixels_without_a_transfer_syntax_are_refused(tmp_path: Path) -> None:
    out = dataset(scene(), 12, tmp_path)
    out.compress(RLELossless)
    data = saved(out, tmp_path).read_bytes()
    (tmp_path / "cut").write_bytes(data[144 + int.from_bytes(data[140:144], "little") :])
    with pytest.raises(ImageError, match="transfer syntax is missing"):
        read_image(tmp_path / "cut")


def test_an_enhanced_object_states_its_geometry_for_each_frame(tmp_path: Path) -> None:
    def group(**sequences: dict) -> pydicom.Dataset:
        return fill(pydicom.Dataset(), **{key: [fill(pydicom.Dataset(), **of)] for key, of in sequences.items()})

    frames = np.stack([scene(seed=k) for k in range(2)])
    out = dataset(frames[0], 12, tmp_path)
    out.NumberOfFrames, out.PixelData = 2, frames.tobytes()
    out.SharedFunctionalGroupsSequence = [
        group(
            XRayGeometrySequence={"DistanceSourceToDetector": 1000.0},
            FramePixelDataPropertiesSequence={"ImagerPixelSpacing": [0.2, 0.3], "PixelIntensityRelationshipSign": -1},
        )
    ]
    out.PerFrameFunctionalGroupsSequence = [
        group(PositionerPositionSequence={"PositionerPrimaryAngle": 5.0, "PositionerSecondaryAngle": -7.0}),
        group(XRayGeometrySequence={"DistanceSourceToDetector": 1100.0}),
    ]
    path = saved(out, tmp_path)
    assert read_image(path, 0).tags == GeometryTags(1000.0, (0.2, 0.3), None, 5.0, -7.0)
    assert read_image(path, 1).tags == GeometryTags(1100.0, (0.2, 0.3))
    np.testing.assert_array_equal(read_image(path, 1).pixels, 4095 - frames[1])


@pytest.mark.parametrize(("bits", "first", "falls"), [(8, 0, False), (16, 0, False), (16, 3, True), (8, -4, True)])
def test_a_palette_in_grey_is_applied_and_one_in_colour_refused(
    tmp_path: Path, bits: int, first: int, falls: bool
) -> None:
    entries = np.arange(256)[:: -1 if falls else 1]
    out = dataset(scene(8), 8, tmp_path)
    out.PhotometricInterpretation = "PALETTE COLOR"
    for colour in ("Red", "Green", "Blue"):
        out.add_new(f"{colour}PaletteColorLookupTableDescriptor", "SS" if first < 0 else "US", [256, first, bits])
        data = entries.astype("u1") if bits == 8 else (entries * 257).astype("<u2")
        out.add_new(f"{colour}PaletteColorLookupTableData", "OW", data.tobytes())
    image = read_image(saved(out, tmp_path))
    np.testing.assert_array_equal(image.pixels, entries[np.clip(scene(8).astype(int) - first, 0, 255)])
    assert image.white == 255
    out.BluePaletteColorLookupTableData = bytes(len(data.tobytes()))
    with pytest.raises(ImageError, match="colour"):
        read_image(saved(out, tmp_path))


@pytest.mark.parametrize("coded", [False, True])
def test_a_run_gives_the_frame_that_is_named_and_is_refused_without(tmp_path: Path, coded: bool) -> None:
    frames = np.stack([scene(seed=k) for k in range(3)])
    out = dataset(frames[0], 12, tmp_path)
    out.NumberOfFrames, out.PixelData = 3, frames.tobytes()
    if coded:
        out.compress(RLELossless)
    path = saved(out, tmp_path)
    for k in range(3):
        np.testing.assert_array_equal(read_image(path, k).pixels, frames[k])
    with pytest.raises(ImageError, match=r"run of 3 frames.*0 to 2"):
        read_image(path)
    for index in (3, -1):
        with pytest.raises(ImageError, match="frames 0 to 2"):
            read_image(path, index)


def test_a_run_of_a_thousand_large_frames_is_read_by_the_frame(tmp_path: Path) -> None:
    frame = scene(shape=(1024, 1024))
    out = dataset(frame, 12, tmp_path)
    out.NumberOfFrames = 1000
    path = saved(out, tmp_path)
    start = path.stat().st_size - frame.nbytes
    with path.open("rb+") as file:
        file.truncate(start + 1000 * frame.nbytes)  # takes no room on the disk
        for at, data in ((start - 4, pack("<I", 1000 * frame.nbytes)), (start + 900 * frame.nbytes, frame.tobytes())):
            file.seek(at)
            file.write(data)
    np.testing.assert_array_equal(read_image(path, 900).pixels, frame)


def test_frames_that_are_not_counted_are_refused_and_bytes_after_a_frame_are_not(tmp_path: Path) -> None:
    coded = transcoded(saved(dataset(scene(8), 8, tmp_path), tmp_path), LOSSLESS["JPEG lossless"], tmp_path / "a.dcm")
    out = pydicom.dcmread(coded)
    frame = next(generate_frames(out.PixelData, number_of_frames=1))
    out.PixelData = encapsulate([frame + bytes(300)])
    np.testing.assert_array_equal(read_image(saved(out, tmp_path)).pixels, scene(8))
    out.PixelData = encapsulate([frame] * 3)
    with pytest.raises(ImageError, match="holds 3 times the pixels of a frame, but its Number of Frames says 1"):
        read_image(saved(out, tmp_path))


@pytest.mark.parametrize("grey", [True, False])
def test_a_colour_image_is_read_where_it_is_grey(tmp_path: Path, grey: bool) -> None:
    colours = np.repeat(scene(8)[..., None], 3, axis=2)
    if not grey:
        colours[5, 5, 0] ^= 4
    out = dataset(scene(8), 8, tmp_path)
    out.SamplesPerPixel, out.PhotometricInterpretation, out.PlanarConfiguration = 3, "RGB", 0
    out.PixelData = colours.tobytes()
    path = saved(out, tmp_path)
    if grey:
        np.testing.assert_array_equal(read_image(path).pixels, scene(8))
    else:
        with pytest.raises(ImageError, match="colour"):
            read_image(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"Rows": 0}, "without an image"),
        ({"Rows": 60000, "Columns": 60000}, "limit"),
        ({"Rows": 8}, "at least 16"),
        ({"BitsAllocated": 32, "BitsStored": 32, "HighBit": 31}, "8 to 16 bits"),
        ({"BitsStored": 4, "HighBit": 3}, "8 to 16 bits"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, "palette"),
        ({"Rows": 4800}, "damaged"),
        ({"Columns": 63}, "holds more pixels than it states"),
        ({"Rows": 47}, "holds more pixels than it states"),
        ({"BitsAllocated": 8, "BitsStored": 8, "HighBit": 7}, "holds 2 times the pixels"),
        ({"Rows": 16}, "holds 3 times the pixels"),
        ({"HighBit": 10}, "High Bit"),
        ({"HighBit": 15}, "all are below 4096"),
        ({"BitsStored": 10, "HighBit": 9}, "above its 10 bits"),
    ],
)
def test_a_header_that_promises_what_is_not_there_is_refused(tmp_path: Path, change: dict, says: str) -> None:
    out = dataset(scene(), 12, tmp_path)
    for keyword, value in change.items():
        setattr(out, keyword, value)
    with pytest.raises(ImageError, match=says):
        read_image(saved(out, tmp_path))


def test_a_file_without_pixels_is_refused(tmp_path: Path) -> None:
    out = dataset(scene(), 12, tmp_path)
    del out.PixelData
    with pytest.raises(ImageError, match=r"image\.dcm holds no pixel data"):
        read_image(saved(out, tmp_path))


@pytest.mark.parametrize("syntax", ["1.2.840.10008.1.2.4.100", "1.2.840.10008.1.2.1.99"])
def test_a_compression_that_cannot_be_read_is_refused(tmp_path: Path, syntax: str) -> None:
    """MPEG-2 video is not an image, and a deflated data set could unpack to any size."""
    out = dataset(scene(), 12, tmp_path)
    if syntax.endswith("4.100"):
        out.PixelData = encapsulate([b"\x00" * 64])
    out.file_meta.TransferSyntaxUID = syntax
    with pytest.raises(ImageError, match="uncompressed"):
        read_image(saved(out, tmp_path))


def test_twelve_bit_lossy_jpeg_which_the_decoders_lack_is_refused(tmp_path: Path) -> None:
    source = saved(dataset(scene(), 12, tmp_path), tmp_path)
    path = transcoded(source, gdcm.TransferSyntax.JPEGExtendedProcess2_4, tmp_path / "coded.dcm")
    with pytest.raises(ImageError, match="uncompressed"):
        read_image(path)


@pytest.mark.parametrize(
    "image",
    [
        Radiograph(scene().astype(np.float32), 4095.0),
        Radiograph(scene(), 4000.0),
        Radiograph(scene(), 1023.0),
        Radiograph(scene(), float("inf")),
    ],
)
def test_pixels_that_dicom_cannot_hold_are_not_written(tmp_path: Path, image: Radiograph) -> None:
    with pytest.raises(ImageError, match="whole numbers"):
        write_dicom(image, tmp_path / "pa.dcm")
    assert not list(tmp_path.iterdir())


def _whole() -> bytes:
    buffer = BytesIO()
    out = pydicom.Dataset()
    out.PatientName, out.SOPClassUID, out.SOPInstanceUID = PATIENT, "1.2.840.10008.5.1.4.1.1.12.1", "1.2.3"
    out.Rows, out.Columns, out.SamplesPerPixel, out.PixelRepresentation = 16, 16, 1, 0
    out.PhotometricInterpretation, out.BitsAllocated, out.BitsStored, out.HighBit = "MONOCHROME2", 8, 8, 7
    out.PixelData = bytes(range(256))
    out.file_meta = pydicom.dataset.FileMetaDataset()
    out.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    pydicom.dcmwrite(buffer, out, enforce_file_format=True)
    return buffer.getvalue()


WHOLE = _whole()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("dicom") / "broken.dcm"


@settings(max_examples=150, deadline=None)
@given(cut=st.integers(0, len(WHOLE) - 1))
def test_a_truncated_file_is_refused_wherever_it_breaks_off(scratch: Path, cut: int) -> None:
    scratch.write_bytes(WHOLE[:cut])
    with pytest.raises(ImageError) as error:
        read_image(scratch)
    assert "Secret" not in str(error.value)


def test_the_patient_reaches_neither_our_types_nor_the_log(tmp_path: Path) -> None:
    """Also with pydicom's logging on, and with malformed values that pydicom quotes."""
    out = dataset(scene(), 12, tmp_path)
    out.DistanceSourceToDetector = "1000"
    path = saved(out, tmp_path)
    path.write_bytes(path.read_bytes().replace(b"1000", b"Secr"))  # pydicom quotes a number that is none
    script = (
        "import logging, sys; logging.basicConfig(level=logging.DEBUG)\n"
        "from sightline import SightlineError, read_image\n"
        "try: print(read_image(sys.argv[1]))\n"
        "except SightlineError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)  # noqa: S603
    assert "Secr" not in done.stdout + done.stderr


def _library_state() -> list[Any]:
    """Return what a host program may have set of the libraries that read images."""
    logs = [logging.getLogger(name) for name in ("pydicom", "pydicom.pixels.utils", "pynetdicom", "PIL")]
    return [[log.disabled, log.propagate, log.level, *log.filters, *log.handlers] for log in logs] + [*warnings.filters]


def test_threads_that_read_leave_a_host_program_its_log_and_its_warnings(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = dataset(scene(), 12, tmp_path)
    out.NumberOfFrames = 0  # pydicom warns of it
    path = saved(out, tmp_path)
    (tmp_path / "image.png").write_bytes(cv2.imencode(".png", scene())[1].tobytes())
    log, done = logging.getLogger("pydicom"), Event()

    def read(times: int = 20) -> None:
        for _ in range(times):
            read_image(path)
            read_image(tmp_path / "image.png")

    read(1)
    before = _library_state()

    def host() -> int:
        said = 0
        while not done.is_set():
            log.warning("of the host")
            with pytest.raises(UserWarning):  # warnings are errors here
                warnings.warn("of the host", stacklevel=1)
            said += 1
        return said

    with caplog.at_level(logging.DEBUG, "pydicom"), ThreadPoolExecutor(5) as pool:
        hosted, readers = pool.submit(host), [pool.submit(read) for _ in range(4)]
        try:
            for reader in readers:
                reader.result()
        finally:
            done.set()
        said = hosted.result()
        assert {record.getMessage() for record in caplog.records} == {"of the host"}
        assert len(caplog.records) >= said > 0
    assert _library_state() == before


@pytest.mark.slow
def test_kernels_compile_after_a_dicom_file_was_read(tmp_path: Path) -> None:
    # gdcm 3.2 loaded before numpy breaks the heap; the compiler is what falls over it.
    path = write_dicom(Radiograph(np.full((64, 64), 500, np.uint16), 4095), tmp_path / "a.dcm")
    program = (
        "import sys, sightline as sl; pixels = sl.read_image(sys.argv[1]).pixels; from numba import njit;"
        "assert njit(lambda x: x.sum())(pixels) == 64 * 64 * 500"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=True)  # noqa: S603


def test_what_is_quiet_stays_a_host_programs_first_filter_and_is_there_once() -> None:
    """And matches nothing once it is over."""
    pydicom_, pillow = Quiet("ignore", "pydicom", all_threads=True), Quiet("error", "PIL")
    with warnings.catch_warnings():
        for _ in range(3):
            with pydicom_(), pillow():
                assert pydicom_.match("pydicom.dataset")
        assert sum(one[3] in (pydicom_, pillow) for one in warnings.filters) == 2
        warnings.simplefilter("error")
        with pydicom_():
            warnings.warn_explicit("of the library", UserWarning, "", 1, "pydicom.dataset")
        with pytest.raises(UserWarning):
            warnings.warn_explicit("of the library", UserWarning, "", 2, "pydicom.dataset")
