"""Files of other people, damaged: each is read or refused by name. Nothing else is ever raised, warned of or printed.

DICOM has more of them in `imaging/test_bad_dicom.py`, views and plans in `case/interop/test_fuzz.py`.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from campaigns.files import FILES, mutated, table_of

from sightline.calibration.exchange.formats import read_view
from sightline.detection.csv_files import read_observations
from sightline.errors import ObservationsError, SightlineError, UnusableInputError
from sightline.imaging import read_image

EACH = 60


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
    assert refused > EACH // 4  # else it was not damaged
    printed, warned = capfd.readouterr()
    assert printed == ""
    assert all(line.startswith("tempfile.tif: ") for line in warned.splitlines())  # of libtiff, on a damaged stream


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
    with pytest.raises(UnusableInputError, match="not a complete NumPy file"):
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
