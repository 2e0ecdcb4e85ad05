"""The undistorted image is a pinhole's, exactly; its matrix carries the view's errors; the raw image is refused."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.calibration import BeadView, calibrate
from sightline.calibration.exchange.formats import FORMATS, read_view, write_view
from sightline.calibration.maps.undistort import undistort
from sightline.case.interop.plate import PlateImage, plate_image, raw_pinhole
from sightline.common.geometry.planes import Plane
from sightline.detection import Observations
from sightline.errors import RefusedError
from sightline.planning import reconstruct
from sightline.twin import bead_images

TARGETS_MM = np.random.default_rng(11).uniform(-35, 35, (12, 3))


@pytest.fixture(scope="module")
def views(setup, frame) -> list[BeadView]:
    rng, noise = np.random.default_rng(3), 0.01 * np.eye(2)
    out = []
    for name in ("pa", "lateral"):
        ids, uv = bead_images(setup, name, rng, 0.1)
        out.append(calibrate(Observations(name, ids, uv, np.repeat(noise[None], len(ids), axis=0)), frame))
    return out


@pytest.fixture(scope="module")
def plates(views) -> list[PlateImage]:
    rows, columns = np.mgrid[:1024, :1024]
    smooth = (20000 + 12000 * np.sin(rows / 90) * np.cos(columns / 70)).astype(np.uint16)
    return [plate_image(view, smooth) for view in views]


def test_the_pinhole_sees_points_where_the_view_has_them_on_its_plate(views, plates) -> None:
    """Through the view's own line of sight: pixel of the raw image, plane, pixel of the plate image."""
    for view, plate in zip(views, plates, strict=True):
        xy = view.lines_of_sight(view.project(TARGETS_MM)).xy_mm
        image = undistort(np.zeros((16, 16), np.uint8), view.plane_map, view.hull)
        wanted = (xy - image.origin_mm) / image.spacing_mm
        assert np.abs(plate.pinhole.view().project(TARGETS_MM) - wanted).max() < 1e-4  # the map's inverse, iterated
        assert np.allclose(plate.pinhole.focal_point_mm, view.focal_point_mm, atol=1e-9)
        assert not plate.pinhole.mirrored


def test_the_other_beam_direction_is_seen_from_the_source_too(views) -> None:
    """The plane's axes turned to be seen from behind: the image is flipped, and the pinhole is still no mirror."""
    view = views[0]
    turned = Plane(view.plane.origin_mm, np.stack([-view.plane.axes[0], view.plane.axes[1]]))

    class Mirrored:
        def to_plane(self, uv_px):
            return view.plane_map.to_plane(uv_px) * [-1, 1]

        def to_image(self, xy_mm):
            return view.plane_map.to_image(xy_mm * [-1, 1])

        def find_image(self, xy_mm):
            return view.plane_map.find_image(xy_mm * [-1, 1])

        def jacobian(self, uv_px):
            return self.linearised(uv_px)[1]

        def linearised(self, uv_px):
            return self.to_plane(uv_px), view.plane_map.jacobian(uv_px) * np.array([-1, 1])[:, None]

    rows, columns = np.mgrid[:1024, :1024]
    pixels = (rows * 3 + columns * 7).astype(np.uint16)
    behind = replace(view, plane=turned, plane_map=Mirrored())
    straight, flipped = plate_image(view, pixels), plate_image(behind, pixels)
    assert not flipped.pinhole.mirrored
    assert np.allclose(flipped.pinhole.rotation, straight.pinhole.rotation, atol=1e-12)
    assert straight.pixels is not None and flipped.pixels is not None
    for plate in (straight, flipped):
        inner = np.rint(plate.pinhole.view().project(TARGETS_MM)).astype(int)
        at = plate.pixels[inner[:, 1], inner[:, 0]].astype(float)
        uv = view.project(TARGETS_MM)
        assert np.abs(at - (uv[:, 1] * 3 + uv[:, 0] * 7)).max() < 10  # one pixel: the target was rounded to one


def test_a_target_keeps_its_place_and_its_error_through_every_format(views, plates, tmp_path) -> None:
    raw = np.stack([view.project(TARGETS_MM) for view in views])
    direct = reconstruct(views, raw)
    sd = np.sqrt(np.trace(direct.covariance_mm2, axis1=1, axis2=2))
    for kind in FORMATS:
        back = []
        for plate in plates:
            for name, data in write_view(plate.pinhole, kind, plate.pixels).items():
                (tmp_path / name).write_bytes(data)
            file = next(
                p
                for p in sorted(tmp_path.glob(f"{plate.pinhole.name}.{kind}.*"))
                if p.suffix in (".json", ".txt", ".xml", ".h5")
            )
            back.append(read_view(file).view())
        px = np.stack([plate.pinhole.view().project(TARGETS_MM) for plate in plates])
        found = reconstruct(back, px)
        assert np.abs(found.xyz_mm - TARGETS_MM).max() < 1e-6, kind
        if kind == "opencv":
            through = np.sqrt(np.trace(found.covariance_mm2, axis1=1, axis2=2))
            assert np.all(np.abs(through / sd - 1) < 0.15)
        else:
            assert found.joint_covariance_mm2 is None


def test_a_distorted_image_is_not_passed_off_as_a_pinholes(views) -> None:
    with pytest.raises(RefusedError, match=r"error of up to \d+\.\d px \(limit 0\.5 px\).*without --raw"):
        raw_pinhole(views[0], (1024, 1024))


def test_a_flat_panels_raw_image_is_one(views, plates) -> None:
    """A view whose map is a homography: that of the plate image itself."""
    plate, view = plates[0].pinhole, views[0]

    class Flat:
        def to_plane(self, uv_px):
            focal, through = plate.focal_point_mm, np.column_stack([uv_px, np.ones(len(uv_px))])
            direction = np.linalg.solve(plate.matrix[:, :3], through.T).T
            return view.plane.central_projection(focal, focal + direction)

    found, residual = raw_pinhole(replace(view, plane_map=Flat()), (1024, 1024))
    assert residual < 1e-4  # where OpenCV stops iterating
    assert np.abs(found.view().project(TARGETS_MM) - plate.view().project(TARGETS_MM)).max() < 1e-4
    assert found.covariance is None
