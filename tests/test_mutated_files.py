"""Files of other people, damaged: each is read or refused by name. Nothing else is ever raised, warned of or printed.

DICOM has more of them in `imaging/test_bad_dicom.py`, views and plans in `case/interop/test_fuzz.py`.
"""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.case.interop.formats import read_view
from sightline.detection.detections_csv import read_detections
from sightline.detection.files import read_observations
from sightline.errors import ObservationsError, SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.frame.measurements import read_measurements
from sightline.frame.table import frame_from_csv
from sightline.imaging import read_image

RNG = np.random.default_rng(3)
GREY8 = RNG.integers(0, 256, (40, 44), dtype=np.uint8)
GREY16 = RNG.integers(0, 65536, (40, 44), dtype=np.uint16)
# What numbers, names and brackets should not be.
NASTY = [
    b"", b"nan", b"-1", b"0", b"1e308", b"1e999", b"9" * 400, b"null", b"[]", b"{", b"(", b"<", b"\0", b"\xff", b"'",
    b'"', b"\n", b"\r", b",", b"1_0",
]  # fmt: skip
EACH = 60


def encoded(pixels: np.ndarray, kind: str, *options: int) -> bytes:
    return cv2.imencode(kind, pixels, options)[1].tobytes()


def npy(pixels: np.ndarray, version: tuple[int, int]) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, pixels, version=version)
    return out.getvalue()


def rows(header: str, row: Callable[[int], str], count: int = 8) -> bytes:
    return "\n".join([header, *(row(k) for k in range(count))]).encode()


def gamma() -> bytes:
    from sightline.frame.files import frame_to_json

    return frame_to_json(Frame.load("gamma"))


def table_of(path: Path) -> Frame:
    return frame_from_csv(path, "own")


FILES: dict[str, tuple[Callable[[], bytes], Callable[[Path], object]]] = {
    "8.png": (lambda: encoded(GREY8, ".png"), read_image),
    "16.png": (lambda: encoded(GREY16, ".png"), read_image),
    "8.bmp": (lambda: encoded(GREY8, ".bmp"), read_image),
    "plain.tif": (lambda: encoded(GREY16, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, 1), read_image),
    "lzw.tif": (lambda: encoded(GREY16, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, 5), read_image),
    "float.tif": (lambda: encoded(GREY8.astype(np.float32), ".tiff"), read_image),
    "1.npy": (lambda: npy(GREY16, (1, 0)), read_image),
    "2.npy": (lambda: npy(GREY8.astype(np.float64), (2, 0)), read_image),
    "frame.json": (gamma, Frame.load),
    "balls.csv": (
        lambda: rows(
            "view,plate,id,x_mm,y_mm,z_mm,diameter_mm,datum,shape,sd_mm",
            lambda k: f"pa,{('xrii', 'source')[k % 2]},b{k},{k % 5}.5,{k * k},{k % 2}.5,3,false,ball,0.1",
            12,
        ),
        table_of,
    ),
    "measured.csv": (
        lambda: rows("id,x_mm,y_mm,z_mm,series,sd_mm,diameter_mm", lambda k: f"pa-x-{k},{k}.5,17.25,4.5,a,0.1,3"),
        read_measurements,
    ),
    "observations.csv": (
        lambda: rows("view,id,u_px,v_px,suu_px2,suv_px2,svv_px2", lambda k: f"pa,pa-x-{k},{k}.5,17.2,0.01,0.001,0.02"),
        read_observations,
    ),
    "detections.csv": (
        lambda: rows("u_px,v_px,radius_px,sd_px,kind,contrast", lambda k: f"{k}.5,17.25,4.5,0.1,ball,0.3"),
        read_detections,
    ),
}


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed in the head or anywhere; the end cut off; a piece replaced, or doubled."""
    out, how = bytearray(data), rng.integers(6)
    head = min(len(out), 200)
    if how < 2:
        for at in rng.integers((len(out), head)[how], size=rng.integers(1, 5)):
            out[at] = rng.integers(256)
    elif how == 2:
        del out[rng.integers(len(out)) :]
    elif how < 5:
        at = int(rng.integers((len(out), head)[how - 3]))
        out[at : at + int(rng.integers(16))] = NASTY[rng.integers(len(NASTY))]
    else:
        at = int(rng.integers(len(out)))
        out[at:at] = out[at : at + int(rng.integers(1, 40))]
    return bytes(out)


@pytest.mark.parametrize("name", FILES)
def test_a_mutated_file_is_read_or_refused_by_name(name: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    make, read = FILES[name]
    data, file, rng = make(), tmp_path / name, np.random.default_rng(20)
    file.write_bytes(data)
    assert read(file)
    refused = 0
    for _ in range(EACH):
        file.write_bytes(mutated(data, rng))
        try:
            read(file)
        except SightlineError as error:
            refused += 1
            assert str(error)
    assert refused > EACH // 4  # else it was not spoilt
    assert capfd.readouterr() == ("", "")


def stating(header: bytes) -> bytes:
    """A NumPy file with this header before 14 kB of numbers."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header + b"\n" + bytes(40 * 44 * 8)


ARRAY = b"{'descr': '%s', 'fortran_order': False, 'shape': %s}"


@pytest.mark.parametrize(
    "header",
    [
        b"-" * 6000 + b"1",  # the parser runs out of stack
        b"(" * 200,
        b"[" * 90 + b"]" * 90,
        b"{'descr': '<u2', 'fortran_order': False, 'shape': (40, 4",
        ARRAY % (b"<u2", b"(40, 44, 99999999999)"),  # 320 TiB
        ARRAY % (b"<u2", b"(40, 44, 0)"),
        ARRAY % (b"<u2", b"(40, -44)"),
        ARRAY % (b"<f8", b"(40, 45)"),  # more than there is
        ARRAY % (b"|V5", b"(40, 44)"),
        ARRAY % (b"|O", b"(40, 44)"),
    ],
)
def test_a_numpy_header_that_lies_is_refused_wherever_one_is_read(header: bytes, tmp_path: Path) -> None:
    file = tmp_path / "pa.opencv.npy"
    file.write_bytes(stating(header))
    with pytest.raises(UnusableInputError, match="npy"):
        read_image(file)
    with pytest.raises(UnusableInputError, match="not a whole NumPy file"):
        read_view(file)


def test_numbers_beyond_all_reason_are_refused(tmp_path: Path) -> None:
    """Their squares overflow, or float32 does."""
    file = tmp_path / "beads.csv"
    file.write_text("view,id,u_px,v_px,suu_px2,suv_px2,svv_px2\npa,a,1,2,0.01,1e308,0.01\n")
    with pytest.raises(ObservationsError, match="not positive definite"):
        read_observations(file)
    np.save(tmp_path / "image.npy", np.full((40, 44), 1e300))
    with pytest.raises(UnusableInputError, match="not finite"):
        read_image(tmp_path / "image.npy")
    balls = FILES["balls.csv"][0]().replace(b",0.1", b",1e300", 1)
    (tmp_path / "balls.csv").write_bytes(balls.replace(b"0.1", b"0.2"))
    with pytest.raises(UnusableInputError, match="not finite"):
        table_of(tmp_path / "balls.csv")


def test_a_matrix_whose_origin_is_the_source_is_refused(tmp_path: Path) -> None:
    """K [I | 0]: nothing tells on which side of the source the patient is."""
    (tmp_path / "pa.json").write_text('{"matrix": [[5000, 0, 500, 0], [0, 5000, 480, 0], [0, 0, 1, 0]]}')
    with pytest.raises(UnusableInputError, match="origin"):
        read_view(tmp_path / "pa.json")
