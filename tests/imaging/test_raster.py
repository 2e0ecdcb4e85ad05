"""Raster and NumPy images are read unchanged, or refused."""

import pickle
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.errors import ImageError, UnusableInputError
from sightline.imaging import Radiograph, as_radiograph, image_checks, read_image, write_png
from sightline.imaging.formats import FORMATS

RNG = np.random.default_rng(11)
GREY8 = RNG.integers(0, 256, (31, 43), dtype=np.uint8)
GREY16 = RNG.integers(0, 65536, (31, 43), dtype=np.uint16)


def encoded(pixels: np.ndarray, kind: str, *options: int) -> bytes:
    return cv2.imencode(kind, pixels, options)[1].tobytes()


def named(tmp_path: Path, data: bytes, name: str = "image.dat") -> Path:
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


@pytest.mark.parametrize(
    ("pixels", "kind", "options"),
    [
        (GREY8, ".png", ()),
        (GREY16, ".png", ()),
        (GREY8, ".bmp", ()),
        (GREY8, ".tiff", ()),
        (GREY16, ".tiff", ()),
        *((GREY16, ".tiff", (cv2.IMWRITE_TIFF_COMPRESSION, c)) for c in (1, 5, 8, 32773)),
        (GREY8.astype(np.float32), ".tiff", ()),
    ],
)
def test_grey_is_read_whatever_the_file_is_called(
    tmp_path: Path, pixels: np.ndarray, kind: str, options: tuple[int, ...]
) -> None:
    image = read_image(named(tmp_path, encoded(pixels, kind, *options)))
    np.testing.assert_array_equal(image.pixels, pixels)
    if pixels.dtype.kind == "u":
        assert image.pixels.dtype == pixels.dtype
        assert image.white == np.iinfo(pixels.dtype).max
    assert not image.pixels.flags.writeable


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tiff"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colour_is_read_where_it_is_grey_and_refused_where_it_is_not(tmp_path: Path, kind: str, channels: int) -> None:
    grey = GREY8 if kind == ".bmp" else GREY16
    colours = np.repeat(grey[..., None], channels, axis=2)
    np.testing.assert_array_equal(read_image(named(tmp_path, encoded(colours, kind))).pixels, grey)
    colours[3, 4, 1] ^= 4 if kind == ".bmp" else 2**11
    with pytest.raises(ImageError, match="colour"):
        read_image(named(tmp_path, encoded(colours, kind)))


@pytest.mark.parametrize("kind", ["u2", "i2"])
def test_the_byte_order_of_an_array_changes_nothing(tmp_path: Path, kind: str) -> None:
    """Signed ones fill the negative half, so the lowest value is black."""
    pixels = (GREY16.astype(np.int32) - (2**15 if kind == "i2" else 0)).astype(f">{kind}")
    np.save(tmp_path / "image.npy", pixels)
    for image in (as_radiograph(pixels), read_image(tmp_path / "image.npy")):
        assert (image.pixels.dtype, image.white) == (np.uint16, 65535.0)
        np.testing.assert_array_equal(image.pixels, GREY16)


def test_a_warning_of_another_program_refuses_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = PIL.Image.open

    def warning(*given: object, **named: object) -> object:
        warnings.warn("of the host", DeprecationWarning, stacklevel=1)
        return opened(*given, **named)

    monkeypatch.setattr(PIL.Image, "open", warning)
    with pytest.warns(DeprecationWarning, match="of the host"):
        np.testing.assert_array_equal(read_image(named(tmp_path, encoded(GREY8, ".png"))).pixels, GREY8)


def test_grey_after_a_colour_conversion_is_read(tmp_path: Path) -> None:
    """Chroma of 127 to 129 about the middle, as a converter's rounding leaves it."""
    chroma = RNG.integers(127, 130, (*GREY8.shape, 2), dtype=np.uint8)
    middle = np.clip(GREY8, 4, 251)
    colours = cv2.cvtColor(np.dstack([middle, chroma]), cv2.COLOR_YCrCb2BGR)
    for kind in (".png", ".bmp"):
        pixels = read_image(named(tmp_path, encoded(colours, kind))).pixels.astype(int)
        assert np.abs(pixels - middle).max() <= 1
    wide = read_image(named(tmp_path, encoded(colours.astype(np.uint16), ".png"))).pixels.astype(int)
    assert np.abs(wide - middle).max() <= 1


@pytest.mark.parametrize("axes", [(0,), (0, 1), (2,)])
def test_an_image_may_have_axes_of_length_one(tmp_path: Path, axes: tuple[int, ...]) -> None:
    stored = np.expand_dims(GREY16, axes)
    np.save(tmp_path / "image.npy", stored)
    np.testing.assert_array_equal(read_image(tmp_path / "image.npy").pixels, GREY16)
    np.testing.assert_array_equal(as_radiograph(stored).pixels, GREY16)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_arrays_are_read(tmp_path: Path, dtype: type) -> None:
    np.save(tmp_path / "image.npy", GREY8.astype(dtype))
    image = read_image(tmp_path / "image.npy")
    np.testing.assert_array_equal(image.pixels, GREY8)
    if np.issubdtype(dtype, np.integer):
        assert image.white == np.iinfo(dtype).max
    else:
        assert not (image.pixels >= image.white).any()
        assert image.white < 1.001 * GREY8.max()


@pytest.mark.parametrize("bits", [8, 16])
def test_a_png_that_is_written_is_read_again(tmp_path: Path, bits: int) -> None:
    pixels = GREY8 if bits == 8 else GREY16
    path = write_png(Radiograph(pixels, 2.0**bits - 1), tmp_path / "image.png")
    np.testing.assert_array_equal(read_image(path).pixels, pixels)
    with pytest.raises(ImageError, match="whole numbers"):
        write_png(Radiograph(pixels.astype(np.float32), 1.0), tmp_path / "other.png")
    with pytest.raises(UnusableInputError, match="cannot write"):
        write_png(Radiograph(pixels, 255.0), tmp_path / "absent" / "image.png")
    assert [p.name for p in tmp_path.iterdir()] == ["image.png"]


def _png_claiming(width: int, height: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
    end = b"\0\0\0\0IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
    return b"\x89PNG\r\n\x1a\n" + chunk + end


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "is empty"),
        (b"\n", "not an image"),
        (b"%PDF-1.7 a report", "not an image"),
        (encoded(GREY8, ".webp"), "not an image"),
        (_png_claiming(6000, 6000), "limit"),
        (_png_claiming(11000, 11000), "limit"),  # Pillow warns
        (_png_claiming(60000, 60000), "limit"),  # and here it refuses
        (encoded(GREY8, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, 7), "LZW, Deflate or PackBits"),
        (_png_claiming(20, 20), "damaged"),
        (encoded(GREY8[:9, :9], ".png"), "at least 16"),
        (encoded(np.full((32, 32), np.nan, np.float32), ".tiff"), "not finite"),
        (cv2.imencodemulti(".tiff", [GREY8, GREY8])[1].tobytes(), "several pages"),
        (pickle.dumps(GREY8), "not an image"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path: Path, data: bytes, says: str) -> None:
    with pytest.raises(ImageError, match=says):
        read_image(named(tmp_path, data))


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.array([{"a": 1}, None], dtype=object), "holds no image"),
        (np.zeros(400), "holds no image"),
        (np.zeros((4, 4)), "at least 16"),
        (np.zeros((32, 32), bool), "bool pixels"),
        (np.zeros((32, 32), np.int64), "int64 pixels"),
        (np.zeros((32, 32), complex), "complex128 pixels"),
        (np.full((32, 32), np.nan), "not finite"),
        (np.zeros((32, 32, 7)), "one image"),
        (np.zeros((1, 3, 32, 7)), "at least 16"),
        (np.linspace(-1, 1, 1024).reshape(32, 32), "50 % .* negative"),
    ],
)
def test_an_array_that_is_no_image_is_refused(tmp_path: Path, array: np.ndarray, says: str) -> None:
    np.save(tmp_path / "image.npy", array, allow_pickle=True)
    with pytest.raises(ImageError, match=says):
        read_image(tmp_path / "image.npy")


def test_a_header_that_claims_a_huge_array_reserves_no_memory(tmp_path: Path) -> None:
    np.save(tmp_path / "image.npy", GREY8)
    data = (tmp_path / "image.npy").read_bytes().replace(b"(31, 43), }        ", b"(99999999, 99999), }")
    with pytest.raises(ImageError, match="limit"):
        read_image(named(tmp_path, data))


@pytest.mark.parametrize(("kind", "tag"), [(".bmp", b""), (".tiff", struct.pack("<HHI", 256, 3, 1))])
def test_a_file_that_holds_more_than_it_states_is_refused_not_sheared(tmp_path: Path, kind: str, tag: bytes) -> None:
    """The stated width is four pixels less: rows of a BMP end at multiples of four bytes."""
    data = bytearray(encoded(GREY8, kind, *((cv2.IMWRITE_TIFF_COMPRESSION, 1) if tag else ())))
    struct.pack_into("<H", data, data.index(tag) + 8 if tag else 18, GREY8.shape[1] - 4)
    with pytest.raises(ImageError, match="holds more pixels than it states"):
        read_image(named(tmp_path, bytes(data)))


@pytest.mark.parametrize("packing", [5, 8, 32773])
def test_a_tiff_with_short_strips_is_refused(tmp_path: Path, packing: int) -> None:
    """The second of its strips states two thirds of its bytes."""
    data = bytearray(encoded(GREY8, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, packing, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 4))
    at = next(k for k in range(len(data)) if data[k : k + 2] == struct.pack("<H", 279) and data[k + 4] == 8)
    kind, _, place = struct.unpack_from("<HII", data, at + 2)
    form = {3: "<2H", 4: "<2I"}[kind]
    first, second = struct.unpack_from(form, data, place)
    struct.pack_into(form, data, place, first, second * 2 // 3)
    with pytest.raises(ImageError, match="damaged"):
        read_image(named(tmp_path, bytes(data)))


def test_a_tiff_whose_numbers_are_no_numbers_is_refused_or_read(tmp_path: Path) -> None:
    """Each entry of the directory in turn is text, or has no value."""
    data = encoded(GREY16, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, 1)
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    refused = set()
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        for where, what in ((entry + 2, 2), (entry + 4, 0)):
            damaged = bytearray(data)
            struct.pack_into("<H", damaged, where, what)
            try:
                read_image(named(tmp_path, bytes(damaged)))
            except ImageError:
                refused.add(struct.unpack_from("<H", data, entry)[0])
    assert refused >= {256, 257, 258, 273, 279}


def test_an_array_with_more_behind_it_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", GREY16)
    data = (tmp_path / "one.npy").read_bytes()
    np.testing.assert_array_equal(read_image(named(tmp_path, data)).pixels, GREY16)
    for more in (data, b"\0"):
        with pytest.raises(ImageError, match="not a complete NumPy file"):
            read_image(named(tmp_path, data + more))


def test_pages_name_all_formats() -> None:
    root = Path(__file__).parents[2]
    pages = {page: (root / page).read_text() for page in ("README.md", "docs/tour.md", "docs/refusals.md")}
    assert [(page, known.name) for page in pages for known in FORMATS if known.name not in pages[page]] == []
    rows = (root / "docs" / "acquire.md").read_text().splitlines()
    assert all(any(row.startswith(f"| {known.name} | {known.holds}") for row in rows) for known in FORMATS)


def test_a_folder_an_absent_file_and_a_frame_of_a_still_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="folder"):
        read_image(tmp_path)
    with pytest.raises(ImageError, match=r"cannot read absent\.png"):
        read_image(tmp_path / "absent.png")
    with pytest.raises(ImageError, match="no frame 1"):
        read_image(named(tmp_path, encoded(GREY8, ".png")), 1)


WHOLE = {kind: encoded(GREY16, kind) for kind in (".png", ".tiff")} | {".bmp": encoded(GREY8, ".bmp")}
BEHIND_PIXELS = {".png": 4, ".tiff": 0, ".bmp": 1}  # bytes: the last checksum, the last row's padding


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("raster") / "broken"


@pytest.mark.parametrize("kind", WHOLE)
@settings(max_examples=50, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_refused_not_filled_up(scratch: Path, kind: str, share: float) -> None:
    length = int(share * len(WHOLE[kind]))
    scratch.write_bytes(WHOLE[kind][:length])
    if len(WHOLE[kind]) - length <= BEHIND_PIXELS[kind]:
        np.testing.assert_array_equal(read_image(scratch).pixels, GREY8 if kind == ".bmp" else GREY16)
        return
    with pytest.raises(ImageError):
        read_image(scratch)


def test_jpeg_is_read_and_says_that_it_was_compressed(tmp_path: Path) -> None:
    smooth = np.add.outer(np.arange(64), np.arange(80)).astype(np.uint8)
    image = read_image(named(tmp_path, encoded(smooth, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95)))
    assert np.abs(image.pixels.astype(int) - smooth).max() <= 2
    assert (image.lossy, image.white) == (True, 255.0)
    followed = encoded(smooth, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95) + bytes(512)
    np.testing.assert_array_equal(read_image(named(tmp_path, followed)).pixels, image.pixels)
    for mode in ("CMYK", "YCbCr"):  # of which the first shows ink, not light
        PIL.Image.fromarray(smooth).convert("RGB").convert(mode).save(tmp_path / "ink", "TIFF")
        assert np.abs(read_image(tmp_path / "ink").pixels.astype(int) - smooth).max() <= 2
    assert [check.name for check in image_checks(image)] == ["clipped pixels", "compression"]
    stored = read_image(named(tmp_path, encoded(smooth, ".png"), "other"))
    assert [check.name for check in image_checks(stored)] == ["clipped pixels"]


@pytest.mark.parametrize("keep", [200, 0.5, -20])
def test_a_jpeg_that_breaks_off_is_refused(tmp_path: Path, keep: float) -> None:
    data = encoded(RNG.integers(0, 256, (200, 200), dtype=np.uint8), ".jpg")
    with pytest.raises(ImageError, match="truncated or damaged"):
        read_image(named(tmp_path, data[: int(keep * len(data)) if 0 < keep < 1 else int(keep)]))


@pytest.mark.parametrize("pixels", [GREY8, GREY16, GREY16.astype(np.float32)])
def test_an_inverted_image_is_the_same_twice_inverted(tmp_path: Path, pixels: np.ndarray) -> None:
    np.save(tmp_path / "image.npy", pixels)
    plain, inverted = (read_image(tmp_path / "image.npy", invert=invert) for invert in (False, True))
    np.testing.assert_allclose(inverted.pixels, plain.white - pixels.astype(float), atol=0.01)
    np.testing.assert_allclose(np.ptp(inverted.inverted().pixels), np.ptp(pixels))
    assert (inverted.pixels < inverted.white).any()
    assert plain.pixels.dtype == inverted.pixels.dtype


def test_the_share_of_clipped_pixels_is_a_check() -> None:
    pixels = np.full((40, 50), 100, np.uint8)
    pixels[:10] = 255
    pixels[10:15] = 0
    (check,) = image_checks(Radiograph(pixels, 255.0))
    assert (check.passed, check.figure) == (True, pytest.approx(37.5))
    pixels[:21] = 255
    assert not image_checks(Radiograph(pixels, 255.0))[0].passed
