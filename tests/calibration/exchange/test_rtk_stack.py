"""RTK geometries of several projections with one stacked MetaImage, both ways."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.calibration.exchange.cameras import pinholes, points_about_hip, project, rtk_ray

from sightline.calibration.exchange.formats import read_projections, read_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.rtk import parsed_xml, write_stack
from sightline.errors import UnusableInputError

POINTS = points_about_hip(8)
SHAPES = [(64, 81), (90, 70), (51, 64)]
SCALES = [1.0, 0.8, 1.37]  # of a pixel, against the first view's


@st.composite
def runs(draw) -> list[Pinhole]:
    """Three cameras with images and pixels of different size; a pixel's sides have one ratio, as RTK's spacing has."""
    pixel = draw(pinholes()).pixel_mm
    views = []
    for shape, scale in zip(SHAPES, SCALES, strict=True):
        view = draw(pinholes())
        own = (pixel[0] * scale, pixel[1] * scale)
        camera = view.camera_matrix.copy()
        camera[1, 1] = camera[0, 0] * own[0] / own[1]
        views.append(replace(view, camera_matrix=camera, shape=shape, pixel_mm=own))
    return views


def images() -> list[np.ndarray]:
    rng = np.random.default_rng(12)
    return [rng.integers(1, 2**16, shape, dtype=np.uint16) for shape in SHAPES]


def written(views: list[Pinhole], folder: Path) -> Path:
    for name, data in write_stack(views, images()).items():
        (folder / name).write_bytes(data)
    return folder / "views.rtk.xml"


@settings(max_examples=15, deadline=None, database=None)
@given(runs())
def test_a_stack_shows_each_pixel_on_its_ray_by_rtks_own_parameters(views: list[Pinhole]) -> None:
    """Geometry k, slice k, row from the bottom: an exchange of slices or of rows gives another pixel or another ray."""
    files = write_stack(views, images())
    header, _, data = files["views.rtk.mha"].partition(b"ElementDataFile = LOCAL\n")
    fields = dict(line.split(" = ") for line in header.decode().splitlines())
    width, height, count = map(int, fields["DimSize"].split())
    across, up, _ = map(float, fields["ElementSpacing"].split())
    stored = np.frombuffer(data, "<u2").reshape(count, height, width)
    assert (count, height, width) == (3, 90, 81)
    projections = parsed_xml(files["views.rtk.xml"]).findall("Projection")
    for k, (view, image, projection) in enumerate(zip(views, images(), projections, strict=True)):
        stated = {child.tag: float(child.text or "") for child in projection if child.tag != "Matrix"}
        u, v = 33, 47
        row = height - 1 - v
        assert stored[k, row, u] == image[v, u]
        source, place = rtk_ray(stated, (u * across, row * up))
        assert np.abs(project(view, (source + 0.6 * (place - source))[None]) - [u, v]).max() < 1e-6  # px


@pytest.fixture(scope="module")
def views() -> list[Pinhole]:
    out = []
    for k, (shape, scale) in enumerate(zip(SHAPES, SCALES, strict=True)):
        angle = 0.3 + 0.7 * k
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        camera = np.array([[3000.0 - 211 * k, 0, 31.3], [0, 3000.0 - 211 * k, 40.7], [0, 0, 1]])
        shift = np.array([1.0, -2.0, 620.0])
        out.append(Pinhole(f"v{k}", camera, turn, shift, shape, tuple(0.31 * np.array([scale, scale]))))
    return out


def test_a_stack_comes_back(views: list[Pinhole], tmp_path: Path) -> None:
    file = written(views, tmp_path)
    back = read_projections(file)
    for k, ((view, image), first, sent) in enumerate(zip(back, views, images(), strict=True)):
        assert view.name == f"proj-{k:03d}"
        named = read_view(file, name=view.name)
        for one in (view, named):
            assert np.abs(one.view().project(POINTS) - project(first, POINTS)).max() < 1e-8  # doubles, all digits
            assert one.shape == (90, 81) and one.pixel_mm == (0.31, 0.31)
        height, width = sent.shape
        assert np.array_equal(image[:height, :width], sent)
        assert not image[height:].any() and not image[:, width:].any()


def test_values_that_all_projections_share_are_read_from_their_place_above(
    views: list[Pinhole], tmp_path: Path
) -> None:
    """RTK writes a parameter once, in the root, where it is equal in all projections."""
    same = [replace(view, camera_matrix=views[0].camera_matrix, pixel_mm=(0.31, 0.31)) for view in views]
    file = written(same, tmp_path)
    text = file.read_text()
    line = next(line for line in text.splitlines() if "<SourceToDetectorDistance>" in line)
    assert text.count(line) == 3
    file.write_text(text.replace(line, "").replace("<Projection>", line + "<Projection>", 1))
    for (view, _), first in zip(read_projections(file), same, strict=True):
        assert np.abs(view.view().project(POINTS) - project(first, POINTS)).max() < 1e-8


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"DimSize = 81 90 3", b"DimSize = 81 90 2", "2 slices, the geometry 3 projections"),
        (b"DimSize = 81 90 3", b"DimSize = 81 91 3", "write all pixels"),
        (b"CompressedData = False", b"CompressedData = True", "uncompressed"),
        (b"ByteOrderMSB = False", b"ByteOrderMSB = True", "little-endian"),
        (b"MET_USHORT", b"MET_DOUBLE", "of MET_DOUBLE"),
        (b"= LOCAL", b"= a.raw", "write all pixels"),
    ],
)
def test_a_stack_that_does_not_fit_is_refused(
    views: list[Pinhole], tmp_path: Path, old: bytes, new: bytes, words: str
) -> None:
    file = written(views, tmp_path)
    image = file.with_suffix(".mha")
    assert old in image.read_bytes()
    image.write_bytes(image.read_bytes().replace(old, new))
    with pytest.raises(UnusableInputError, match=words) as refused:
        read_projections(file)
    assert "views.rtk.xml" in str(refused.value)


@pytest.mark.parametrize("name", ["pa", "proj-003", "proj-1"])
def test_a_projection_of_several_is_named(views: list[Pinhole], tmp_path: Path, name: str) -> None:
    with pytest.raises(UnusableInputError, match="name one of its 3: proj-000, proj-001, proj-002"):
        read_view(written(views, tmp_path), name=name)


def test_pixels_of_another_ratio_cannot_share_a_stack(views: list[Pinhole]) -> None:
    camera = views[1].camera_matrix * np.array([[1.0], [0.9], [1.0]])
    other = replace(views[1], camera_matrix=camera, pixel_mm=(0.27, 0.3))
    with pytest.raises(UnusableInputError, match="one focal length"):
        write_stack([views[0], other], [None, None])
