"""Files with damaged bytes: each must be read, or refused with its name; no other exception may be raised.

Views and plans of other programs are in tests/case/interop/test_fuzz.py.
"""

import io
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from campaigns.campaign import Campaign, Damage, Ended
from sightline.detection.csv_files import read_detections, read_observations
from sightline.frame import Frame
from sightline.frame.tables import frame_from_csv, read_measurements
from sightline.imaging import Radiograph, read_image, write_dicom

RNG = np.random.default_rng(3)
GREY8 = RNG.integers(0, 256, (40, 44), dtype=np.uint8)
GREY16 = RNG.integers(0, 65536, (40, 44), dtype=np.uint16)
# Invalid replacements for numbers, names and brackets.
NASTY = [
    b"", b"nan", b"-1", b"0", b"1e308", b"1e999", b"9" * 400, b"null", b"[]", b"{", b"(", b"<", b"\0", b"\xff", b"'",
    b'"', b"\n", b"\r", b",", b"1_0",
]  # fmt: skip


def encoded(pixels: np.ndarray, kind: str, *options: int) -> bytes:
    return cv2.imencode(kind, pixels, options)[1].tobytes()


def npy(pixels: np.ndarray, version: tuple[int, int]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, pixels, version=version)
    return stream.getvalue()


def dicom() -> bytes:
    """Return a DICOM image as the twin's C-arm stores it."""
    with tempfile.TemporaryDirectory() as folder:
        return write_dicom(Radiograph(GREY16, 65535.0), Path(folder) / "image.dcm").read_bytes()


def rows(header: str, row: Callable[[int], str], count: int = 8) -> bytes:
    return "\n".join([header, *(row(k) for k in range(count))]).encode()


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
    "frame.json": (lambda: Frame.load("gamma").to_json(), Frame.load),
    "image.dcm": (dicom, read_image),
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
    """Return bytes with changes in the head or anywhere, a missing end, or a replaced or doubled piece."""
    changed, how = bytearray(data), rng.integers(6)
    head = min(len(changed), 200)
    if how < 2:
        for at in rng.integers((len(changed), head)[how], size=rng.integers(1, 5)):
            changed[at] = rng.integers(256)
    elif how == 2:
        del changed[rng.integers(len(changed)) :]
    elif how < 5:
        at = int(rng.integers((len(changed), head)[how - 3]))
        changed[at : at + int(rng.integers(16))] = NASTY[rng.integers(len(NASTY))]
    else:
        at = int(rng.integers(len(changed)))
        changed[at:at] = changed[at : at + int(rng.integers(1, 40))]
    return bytes(changed)


def of_file(name: str) -> Damage:
    """Return the class of one kind of file."""
    make, read = FILES[name]
    whole = lru_cache(make)

    def go(rng: np.random.Generator) -> Ended:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / name
            file.write_bytes(mutated(whole(), rng))
            read(file)
        return Ended("right")

    return Damage(go)


CAMPAIGN = Campaign("files", "Files damaged byte by byte", {name: of_file(name) for name in FILES})
