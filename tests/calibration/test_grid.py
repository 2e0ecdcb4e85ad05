"""A sheet without ids: its lattice is indexed right or refused, and its map has the error that it states."""

from collections.abc import Callable

import numpy as np
import pytest

from sightline.calibration.maps.grid import GridMap, Undistorter, map_grid
from sightline.detection import Detections, detect
from sightline.detection.lattice import HEXAGONAL, SQUARE, lattice_of_sheet
from sightline.errors import CalibrationRefusedError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin import Scene, ViewTruth, draw_setup, render
from sightline.twin.objects.things import Ball

PITCH_MM = 10.0
Keep = Callable[[np.ndarray], np.ndarray]


def turned(xy: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return xy @ np.array([[c, s], [-s, c]])


class Sheet:
    """Points of a sheet somewhere on the twin's intensifier: `index`, `xy_mm` on its input plane, true pixels."""

    def __init__(self, seed: int, axes: np.ndarray = SQUARE, keep: Keep = lambda index: index[:, 0] < np.inf) -> None:
        self.rng = np.random.default_rng(seed)
        self.view: ViewTruth = draw_setup(self.rng, Frame.load("gamma")).views["pa"]
        index = np.stack(np.meshgrid(*2 * (np.arange(-25, 26),)), axis=-1).reshape(-1, 2)
        place = turned(PITCH_MM * index @ axes, self.rng.uniform(0, 3)) + self.rng.uniform(-5, 5, 2)
        shown = (np.linalg.norm(place, axis=1) < 115) & keep(index)
        self.index, self.xy_mm, self.hexagonal = index[shown], place[shown], axes is HEXAGONAL
        uv_px = self.view.intensifier.to_image(self.xy_mm)
        inside = self.view.in_field(uv_px, 8.0)
        self.index, self.xy_mm, self.uv_px = self.index[inside], self.xy_mm[inside], uv_px[inside]

    def seen(self, noise_px: float) -> np.ndarray:
        return self.uv_px + noise_px * self.rng.standard_normal(self.uv_px.shape)

    def errors(self, grid: GridMap, at_px: np.ndarray) -> np.ndarray:
        """Errors of a map (N, 2), px, against the truth carried into its coordinates by its own points."""
        near = np.linalg.norm(grid.uv_px[:, None] - self.uv_px, axis=2).argmin(axis=1)
        a, b = (xy @ [1, 1j] for xy in (self.xy_mm[near], grid.spacing_mm * grid.ideal_px))
        a_0, b_0 = a.mean(), b.mean()
        rotation = np.vdot(a - a_0, b - b_0) / np.vdot(a - a_0, a - a_0)
        np.testing.assert_allclose(rotation * (a - a_0), b - b_0, atol=1e-6)  # indexed right, and never mirrored here
        assert abs(rotation) == pytest.approx(1, abs=1e-9)
        true = rotation * (self.view.intensifier.to_detector(at_px) @ [1, 1j] - a_0) + b_0
        off = grid.plane_map.to_plane(at_px) @ [1, 1j] - true
        return np.column_stack([off.real, off.imag]) / grid.spacing_mm

    def places(self, grid: GridMap) -> np.ndarray:
        """Pixels off the lattice that the map covers."""
        at = self.rng.uniform(0, 1023, (1000, 2))
        return at[grid.covers(at) & self.view.in_field(at)]


def beads(uv_px: np.ndarray, kind: str = "ball") -> Detections:
    n = len(uv_px)
    return Detections(
        uv_px=uv_px,
        radius_px=np.full(n, 5.0),
        covariance_px2=np.repeat(1e-3 * np.eye(2)[None], n, axis=0),
        kind=(kind,) * n,
        contrast=np.full(n, -0.5),
        image_shape=(1024, 1024),
    )


class TestErrorOfAGridMap:
    """Normalised errors have a mean square of about 1; sampled over 6 tubes and places, it is known to a tenth."""

    @pytest.mark.parametrize("axes", [SQUARE, HEXAGONAL], ids=["square", "hexagonal"])
    @pytest.mark.parametrize("noise_px", [0.03, 0.15])
    def test_it_is_as_stated_off_the_lattice(self, axes: np.ndarray, noise_px: float) -> None:
        squares = []
        for seed in range(6):
            sheet = Sheet(seed, axes)
            grid = map_grid(beads(sheet.seen(noise_px)), PITCH_MM)
            assert grid.hexagonal is sheet.hexagonal
            at = sheet.places(grid)
            squares.append(np.square(sheet.errors(grid, at) / grid.sd_px(at)[:, None]).mean())
        assert 0.7 < np.mean(squares) ** 0.5 < 1.15

    def test_it_is_as_stated_where_rows_were_punched_with_common_errors(self) -> None:
        squares = []
        for seed in range(5):
            sheet = Sheet(seed, HEXAGONAL)
            row = sheet.index[:, 1] + 30
            common = 0.15 * sheet.rng.standard_normal((60, 2))
            grid = map_grid(beads(sheet.seen(0.05) + common[row], "hole"), PITCH_MM)
            assert grid.row_error_px > 0.08
            at = sheet.places(grid)
            squares.append(np.square(sheet.errors(grid, at) / grid.sd_px(at)[:, None]).mean())
        assert 0.6 < np.mean(squares) ** 0.5 < 1.2


class TestLatticeOfASheet:
    @pytest.mark.parametrize(
        ("keep", "least"),
        [
            (lambda index: index[:, 0] != 2, 1.0),  # the lattice goes on beyond a missing row, by two and not by one
            (lambda index: index[:, 0] > 3, 1.0),  # partly outside of the image
            (lambda index: (index[:, 0] % 4 != 1) | (index[:, 1] % 3 != 0), 1.0),
        ],
        ids=["row", "outside", "holes"],
    )
    def test_gaps_do_not_change_the_index(self, keep: Keep, least: float) -> None:
        sheet = Sheet(3, keep=keep)
        lattice = lattice_of_sheet(sheet.seen(0.1))
        assert len(lattice) >= least * len(sheet.uv_px)
        change = np.linalg.lstsq(
            np.column_stack([lattice.index, np.ones(len(lattice))]), sheet.index[lattice.members], rcond=None
        )[0]
        np.testing.assert_allclose(change, np.rint(change), atol=1e-9)  # the same lattice from another start
        assert abs(np.linalg.det(change[:2])) == pytest.approx(1)

    def test_points_that_are_not_of_the_sheet_are_left_out(self) -> None:
        sheet = Sheet(4)
        uv_px = sheet.seen(0.05)
        uv_px[[7, 30]] += [[3.0, 0.0], [0.0, -4.0]]
        grid = map_grid(beads(np.concatenate([uv_px, sheet.rng.uniform(200, 800, (12, 2))])), PITCH_MM)
        assert 2 <= grid.left_out <= 12
        at = sheet.places(grid)
        assert np.sqrt(np.square(sheet.errors(grid, at)).mean()) < 0.05

    def test_two_sheets_are_refused(self) -> None:
        one, other = Sheet(5), Sheet(6)
        with pytest.raises(RefusedError, match="one sheet alone"):
            lattice_of_sheet(np.concatenate([one.seen(0.1), other.seen(0.1)]))

    @pytest.mark.parametrize(("scale", "angle"), [(1.0, 5e-4), (1.0005, 0.0), (1.002, 3e-3)])
    def test_two_sheets_half_a_pitch_apart_are_refused(self, scale: float, angle: float) -> None:
        """Both are one lattice. The upper one is turned a little, or 0.5 mm nearer to the source."""
        sheet = Sheet(5)
        steps = np.linalg.lstsq(sheet.index - sheet.index[0], sheet.xy_mm - sheet.xy_mm[0], rcond=None)[0]
        upper = scale * turned(sheet.xy_mm + steps.sum(axis=0) / 2, angle)
        shown = np.concatenate([sheet.xy_mm, upper[np.linalg.norm(upper, axis=1) < 110]])
        uv_px = sheet.view.intensifier.to_image(shown)
        with pytest.raises(CalibrationRefusedError, match="two sheets"):
            map_grid(beads(uv_px + 0.05 * sheet.rng.standard_normal(uv_px.shape)), PITCH_MM)

    @pytest.mark.parametrize("shift_mm", [1.5, 3.0, 5.0])
    def test_a_sheet_with_shifted_rows_is_refused(self, shift_mm: float) -> None:
        sheet = Sheet(7)
        along = sheet.xy_mm[sheet.index[:, 1] == 0]
        step = (along[-1] - along[0]) / np.linalg.norm(along[-1] - along[0])
        moved = sheet.xy_mm + np.where(sheet.index[:, 1:] > 0, shift_mm, 0.0) * step
        with pytest.raises(RefusedError):
            map_grid(beads(sheet.view.intensifier.to_image(moved)), PITCH_MM)

    def test_a_rectangular_lattice_is_refused(self) -> None:
        sheet = Sheet(8)
        with pytest.raises(CalibrationRefusedError, match=r"stretched by a factor of 1\.1"):
            map_grid(beads(sheet.view.intensifier.to_image(sheet.xy_mm * [1.0, 1.12])), PITCH_MM)

    def test_a_small_tilt_is_taken_for_the_sheets_plane(self) -> None:
        """Seen from 1 m: the map takes pixels to the tilted sheet."""
        sheet = Sheet(9)
        depth = 1 + sheet.xy_mm[:, :1] * np.sin(np.radians(10)) / 1000
        on_detector = sheet.xy_mm * [np.cos(np.radians(10)), 1.0] / depth
        grid = map_grid(beads(sheet.view.intensifier.to_image(on_detector)), PITCH_MM)
        assert grid.document()["leave_one_out_rms_px"] < 0.02

    @pytest.mark.parametrize(
        ("keep", "message"),
        [(lambda i: abs(i).max(axis=1) < 2, "at least"), (lambda i: abs(i).max(axis=1) < 3, "25 p")],
    )
    def test_too_few_points_are_refused(self, keep: Keep, message: str) -> None:
        with pytest.raises(RefusedError, match=message):
            map_grid(beads(Sheet(1, keep=keep).uv_px), PITCH_MM)

    @pytest.mark.parametrize("pitch_mm", [0.0, -1.0, np.nan, np.inf])
    def test_a_pitch_that_is_no_length_is_refused(self, pitch_mm: float) -> None:
        with pytest.raises(UnusableInputError, match="pitch"):
            map_grid(beads(np.zeros((50, 2))), pitch_mm)


class TestUndistorter:
    def test_straight_and_even_where_the_sheet_is_seen(self) -> None:
        """Rendered balls, found again in the undistorted image: their lattice fits a similarity to 0.1 px."""
        rng = np.random.default_rng(11)
        setup = draw_setup(rng, Frame.load("gamma"))
        view = setup.views["pa"]
        index = np.stack(np.meshgrid(*2 * (np.arange(-11, 12),)), axis=-1).reshape(-1, 2)
        xyz = view.detector.to_space(turned(PITCH_MM * index, 0.4)) - 3.0 * view.detector.normal
        image = render(
            setup, "pa", Scene(solids=tuple(Ball((x, y, z), 1.0, within=None) for x, y, z in xyz.tolist())), rng
        )
        grid = map_grid(detect(image), PITCH_MM)
        middle_mm = 0.997 / view.intensifier.px_per_mm  # the sheet is 3 mm before the input plane
        assert grid.spacing_mm == pytest.approx(middle_mm, rel=0.08)  # pincushion: the scale is a mean over the field
        again = map_grid(detect(Radiograph(Undistorter(grid)(image.pixels, image.white), image.white)), PITCH_MM)
        off_px = np.linalg.norm(again.ideal_px - again.uv_px, axis=1)
        assert np.linalg.norm(grid.ideal_px - grid.uv_px, axis=1).max() > 3
        assert off_px.max() < 0.3 and np.sqrt(np.mean(off_px**2)) < 0.1  # noise of centres is 0.03 px
        assert again.spacing_mm == pytest.approx(grid.spacing_mm, rel=1e-4)

    def test_every_pixel_comes_from_where_the_map_says(self) -> None:
        sheet = Sheet(12)
        grid = map_grid(beads(sheet.uv_px), PITCH_MM)
        rows, columns = sheet.rng.integers(100, 900, (2, 400))
        uv_px, ideal_px = grid.sources()[rows, columns].astype(float), np.column_stack([columns, rows])
        seen = grid.covers(uv_px)
        assert 300 < seen.sum() < 400
        np.testing.assert_allclose(  # to 0.01 px
            grid.plane_map.to_plane(uv_px[seen]), grid.spacing_mm * ideal_px[seen], atol=0.01 * grid.spacing_mm
        )

    def test_another_size_is_refused_and_values_stay_in_range(self) -> None:
        undistorter = Undistorter(map_grid(beads(Sheet(13).uv_px), PITCH_MM))
        board = np.indices((1024, 1024)).sum(axis=0) // 7 % 2 * 4095
        pixels = undistorter(board.astype(np.uint16), 4095.0)
        assert pixels.dtype == np.uint16 and pixels.max() == 4095
        assert pixels[0, 0] == 0  # outside of the sheet
        with pytest.raises(UnusableInputError, match="1024 x 1024"):
            undistorter(board[:512].astype(np.uint16), 4095.0)
