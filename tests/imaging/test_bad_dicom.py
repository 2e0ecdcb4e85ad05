"""Damaged and hostile DICOM files: each is read or refused; none ends the program or fills the memory."""

import struct
from pathlib import Path

import gdcm
import numpy as np
import pytest
from pydicom import dcmread
from pydicom.encaps import encapsulate, get_frame
from pydicom.uid import JPEG2000Lossless, JPEGLosslessSV1, JPEGLSLossless, RLELossless
from tests.imaging.transcoding import transcoded

from sightline.errors import ImageError
from sightline.imaging import Radiograph, dicom, read_image, write_dicom
from sightline.imaging.decoder import Decoder, UndecodableError, unpacks_to

SYNTAXES = {
    "native": None,
    "JPEG": JPEGLosslessSV1,
    "JPEG-LS": JPEGLSLossless,
    "JPEG 2000": JPEG2000Lossless,
    "RLE": RLELossless,
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the same image in each transfer syntax."""
    folder = tmp_path_factory.mktemp("syntaxes")
    pixels = np.random.default_rng(1).integers(0, 4096, (64, 64), dtype=np.uint16)
    native = write_dicom(Radiograph(pixels, 4095.0), folder / "native.dcm")
    coded = {name: gdcm.TransferSyntax.GetTSType(str(uid)) for name, uid in SYNTAXES.items() if uid is not None}
    return {"native": native} | {
        name: transcoded(native, syntax, folder / f"{name}.dcm") for name, syntax in coded.items()
    }


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with changes in the header, anywhere or in the pixels, a missing end, or a replaced piece."""
    out, how = bytearray(data), rng.integers(5)
    if how == 3:
        return bytes(out[: rng.integers(len(out))])
    if how == 4:
        at = int(rng.integers(132, len(out) - 80))
        out[at : at + int(rng.integers(1, 64))] = rng.bytes(int(rng.integers(0, 80)))
        return bytes(out)
    start, end = ((132, 1200), (0, len(out)), (len(out) // 3, len(out)))[how]
    for at in rng.integers(start, min(end, len(out)), rng.integers(1, 9)):
        out[at] = rng.integers(256)
    return bytes(out)


@pytest.mark.parametrize("name", SYNTAXES)
def test_mutated_files_are_read_or_refused(files: dict[str, Path], name: str, tmp_path: Path) -> None:
    """Any error but ImageError fails. The campaign `files` mutates thousands."""
    rng, target, data = np.random.default_rng(20), tmp_path / "mutated.dcm", files[name].read_bytes()
    read = 0
    for _ in range(30):
        target.write_bytes(mutated(data, rng))
        try:
            image = read_image(target)
        except ImageError as error:
            assert "PHANTOM" not in str(error)
        else:
            assert image.pixels.size <= 2**25
            read += 1
    assert read < 30
    assert read > 0 or name != "native"


@pytest.mark.parametrize("name", list(SYNTAXES)[1:])
def test_a_frame_tells_its_size_before_it_is_decoded(files: dict[str, Path], name: str) -> None:
    coded = get_frame(dcmread(files[name]).PixelData, 0, number_of_frames=1)
    syntax = str(SYNTAXES[name])
    assert unpacks_to(coded, syntax, (64, 64), "")
    if name == "RLE":  # a longer run at its end is padding, a row is not
        assert unpacks_to(coded, syntax, (45, 91), "")
        with pytest.raises(ImageError, match="more pixels than it states"):
            unpacks_to(coded, syntax, (64, 63), "")
    else:
        assert not unpacks_to(coded, syntax, (64, 63), "")
    assert not unpacks_to(coded, syntax, (65, 64), "")
    assert not unpacks_to(coded[:8], syntax, (64, 64), "")
    assert not unpacks_to(b"", syntax, (64, 64), "")


def test_a_frame_that_unpacks_to_more_than_its_file_says_never_reaches_a_decoder(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object) -> None:
        pytest.fail("a decoder was called")

    monkeypatch.setattr(dicom._decoder, "decode", decode)
    bomb = dcmread(files["RLE"])
    segments = struct.pack("<16I", 2, 64, 64 + 20000, *[0] * 13) + b"\x81\x00" * 20000  # 128 times 10,000, twice
    bomb.PixelData = encapsulate([segments])
    bomb.save_as(tmp_path / "rle.dcm")
    with pytest.raises(ImageError, match="damaged, or compressed"):
        read_image(tmp_path / "rle.dcm")
    wide = files["JPEG 2000"].read_bytes()
    at = wide.index(b"\xff\x4f\xff\x51") + 8
    (tmp_path / "j2k.dcm").write_bytes(wide[:at] + struct.pack(">II", 60000, 60000) + wide[at + 8 :])
    with pytest.raises(ImageError, match="damaged, or compressed"):
        read_image(tmp_path / "j2k.dcm")


@pytest.mark.slow
def test_a_decoder_that_dies_refuses_that_file_and_reads_the_next(files: dict[str, Path], monkeypatch) -> None:
    decoder = Decoder()
    try:
        expected = read_image(files["native"]).pixels
        np.testing.assert_array_equal(decoder.decode(files["JPEG"], 0), expected)
        assert decoder._helper is not None
        decoder._helper.kill()
        decoder._helper.wait()
        np.testing.assert_array_equal(decoder.decode(files["RLE"], 0), expected)
        with pytest.raises(UndecodableError):
            decoder.decode(files["RLE"], 7)
        monkeypatch.setattr("sightline.imaging.decoder.DEADLINE_S", 0.0)  # killed at once, within its answer
        decoder._helper.kill()
        with pytest.raises(UndecodableError):
            decoder.decode(files["JPEG"], 0)
        monkeypatch.undo()
        np.testing.assert_array_equal(decoder.decode(files["JPEG"], 0), expected)
    finally:
        decoder.close()
