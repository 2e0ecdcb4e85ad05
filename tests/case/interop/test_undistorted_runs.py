"""Runs without distortion: the same kind of file, whole files only, no identity, and on after an interruption."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydicom import dcmread

from sightline.calibration.maps.grid import GridMap, Undistorter
from sightline.case.interop.undistorted import RECORD, UndistortedRun, undistort_runs
from sightline.errors import ImageError, SightlineError, UnusableInputError
from sightline.imaging import Radiograph, read_image, write_dicom

SHAPE = (120, 150)
PATIENT = "MUSTER^ERIKA"


@pytest.fixture(scope="module")
def grid() -> GridMap:
    """A map with 3 % of pincushion, from exact points."""
    index = np.stack(np.meshgrid(np.arange(-7, 8), np.arange(-5, 6)), axis=-1).reshape(-1, 2)
    off = 11.0 * index
    uv_px = np.array([75.3, 59.2]) + off * (1 + 5e-6 * np.square(off).sum(axis=1, keepdims=True))
    return GridMap(uv_px, index, False, 5.0, SHAPE, "ball")


def frames(count: int, dtype: type = np.uint16) -> list[np.ndarray]:
    """Smooth noise, another in each frame; uint16 has 12 bits."""
    rng, top = np.random.default_rng(5), 255 if dtype is np.uint8 else 4095
    blurred = (cv2.GaussianBlur(rng.normal(0, 1, SHAPE), (0, 0), 2.0) for _ in range(count))
    return [np.clip(top * (0.5 + 1.5 * each), 0, top).astype(dtype) for each in blurred]


def dicom_run(file: Path, images: list[np.ndarray]) -> Path:
    """A run with a patient's name, 40 ms a frame."""
    dataset = dcmread(write_dicom(Radiograph(images[0], 4095.0), file))
    dataset.NumberOfFrames, dataset.PatientName, dataset.FrameTime = len(images), PATIENT, "40"
    data = b"".join(image.tobytes() for image in images)
    dataset.PixelData = data + b"\0" * (len(data) % 2)
    dataset.save_as(file)
    return file


def video(file: Path, images: list[np.ndarray]) -> Path:
    code, grey = cv2.VideoWriter.fourcc(*"FFV1"), [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, code, 50.0, SHAPE[::-1], grey)
    for image in images:
        writer.write(image)
    writer.release()
    return file


def folder_of(place: Path, images: list[np.ndarray], suffix: str) -> Path:
    place.mkdir()
    for k, image in enumerate(images):
        file = place / f"Muster_Erika_{k:02d}{suffix}"
        if suffix == ".npy":
            np.save(file, image)
        elif suffix == ".dcm":
            write_dicom(Radiograph(image, 4095.0), file)
        else:
            cv2.imwrite(str(file), image)
    return place


def undistort(
    paths: list[Path], grid: GridMap, out: Path, advance: Callable[[], None] = lambda: None
) -> tuple[list[Path], int]:
    runs = [UndistortedRun.of(path, k) for k, path in enumerate(paths, 1)]
    return undistort_runs(runs, grid, out, advance)


class TestUndistortedRuns:
    @pytest.mark.parametrize(
        ("suffix", "written"), [(".png", ".png"), (".tif", ".tif"), (".npy", ".npy"), (".dcm", ".dcm")]
    )
    def test_a_folder_becomes_a_folder_of_the_same_kind(
        self, grid: GridMap, tmp_path: Path, suffix: str, written: str
    ) -> None:
        images = frames(6)
        files, already = undistort([folder_of(tmp_path / "in", images, suffix)], grid, tmp_path / "out")
        assert [file.name for file in files] == [f"{k:05d}{written}" for k in range(1, 7)] and already == 0
        resample, white = Undistorter(grid), 4095.0 if suffix == ".dcm" else 65535.0
        for file, image in zip(files, images, strict=True):
            np.testing.assert_array_equal(read_image(file).pixels, resample(image, white))
            assert b"uster" not in file.read_bytes()
        assert "uster" not in (tmp_path / "out" / RECORD).read_text()

    def test_jpeg_becomes_png_without_another_loss(self, grid: GridMap, tmp_path: Path) -> None:
        place = folder_of(tmp_path / "in", frames(1, np.uint8), ".jpg")
        (file,), _ = undistort([next(place.iterdir())], grid, tmp_path / "out")
        assert file.name == "run-1.png"
        lossy = read_image(next(place.iterdir())).pixels
        np.testing.assert_array_equal(read_image(file).pixels, Undistorter(grid)(lossy, 255.0))

    def test_a_dicom_run_stays_one_without_its_patient(self, grid: GridMap, tmp_path: Path) -> None:
        images = frames(7)
        (file,), _ = undistort([dicom_run(tmp_path / "run.dcm", images)], grid, tmp_path / "out")
        header = dcmread(file)
        assert (header.NumberOfFrames, header.FrameTime, header.BitsStored) == (7, 40, 12)
        assert header.PixelSpacing == pytest.approx([grid.spacing_mm] * 2)
        assert PATIENT.encode() not in file.read_bytes()
        resample = Undistorter(grid)
        for k, image in enumerate(images):
            np.testing.assert_array_equal(read_image(file, k).pixels, resample(image, 4095.0))

    def test_a_video_stays_one_without_loss(self, grid: GridMap, tmp_path: Path) -> None:
        images = frames(9, np.uint8)
        (file,), _ = undistort([video(tmp_path / "run.avi", images)], grid, tmp_path / "out")
        capture, resample = cv2.VideoCapture(str(file)), Undistorter(grid)
        assert capture.get(cv2.CAP_PROP_FPS) == 50
        for image in images:
            good, shown = capture.read()
            assert good
            np.testing.assert_array_equal(shown[..., 0], resample(image, 255.0))
        assert not capture.read()[0]

    def test_an_interrupted_call_goes_on_and_leaves_no_half_file(self, grid: GridMap, tmp_path: Path) -> None:
        paths = [folder_of(tmp_path / "in", frames(12), ".png"), dicom_run(tmp_path / "run.dcm", frames(12))]
        out, steps = tmp_path / "out", iter(range(14))

        def until() -> None:
            if next(steps, None) is None:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            undistort(paths, grid, out, until)
        assert not (out / "run-2.dcm").exists() and not list(out.glob(".*"))
        written = {file: file.stat().st_mtime_ns for file in out.glob("run-1/*")}
        assert len(written) == 12
        (out / "run-1" / ".00003.png.1.2.part").write_bytes(b"killed")
        (out / "run-1" / "00003.png").unlink()
        del written[out / "run-1" / "00003.png"]
        count = []
        files, already = undistort(paths, grid, out, lambda: count.append(1))
        assert already == 11 and len(count) == 24
        assert all(file.exists() for file in files) and not list(out.rglob(".*.part"))
        assert all(file.stat().st_mtime_ns == time for file, time in written.items())
        assert undistort(paths, grid, out) == (files, 13)

    def test_a_frame_that_cannot_be_read_leaves_the_run_unwritten(self, grid: GridMap, tmp_path: Path) -> None:
        file = dicom_run(tmp_path / "run.dcm", frames(5))
        run = UndistortedRun.of(file, 1)
        file.write_bytes(file.read_bytes()[: -2 * SHAPE[0] * SHAPE[1]])
        with pytest.raises(SightlineError):
            undistort_runs([run], grid, tmp_path / "out", lambda: None)
        assert [each.name for each in (tmp_path / "out").iterdir()] == [RECORD]

    def test_a_video_that_ends_early_is_refused(self, grid: GridMap, tmp_path: Path) -> None:
        file = video(tmp_path / "run.avi", frames(9, np.uint8))
        run = UndistortedRun.of(file, 1)
        video(file, frames(4, np.uint8))
        with pytest.raises(ImageError, match="ends after 4 of 9"):
            undistort_runs([run], grid, tmp_path / "out", lambda: None)
        assert not (tmp_path / "out" / "run-1.avi").exists()

    def test_another_map_or_other_runs_are_not_mixed_in(self, grid: GridMap, tmp_path: Path) -> None:
        one = folder_of(tmp_path / "one", frames(2), ".png")
        undistort([one], grid, tmp_path / "out")
        with pytest.raises(UnusableInputError, match="another map"):
            undistort([one], replace(grid, pitch_mm=6.0), tmp_path / "out")
        with pytest.raises(UnusableInputError, match="other runs"):
            undistort([folder_of(tmp_path / "two", frames(3), ".png")], grid, tmp_path / "out")
        with pytest.raises(UnusableInputError, match="other files"):
            undistort([one], grid, one)

    def test_another_trial_of_the_same_size_is_not_taken_for_the_first(self, grid: GridMap, tmp_path: Path) -> None:
        images = frames(4)  # .npy: all files have the same size
        undistort([folder_of(tmp_path / "one", images[:2], ".npy")], grid, tmp_path / "out")
        with pytest.raises(UnusableInputError, match="other runs"):
            undistort([folder_of(tmp_path / "two", images[2:], ".npy")], grid, tmp_path / "out")

    def test_frames_are_numbered_by_value(self, grid: GridMap, tmp_path: Path) -> None:
        (tmp_path / "in").mkdir()
        images = frames(3)
        for number, image in zip((2, 10, 100), images, strict=True):
            np.save(tmp_path / "in" / f"Frame{number}.npy", image)
        files, _ = undistort([tmp_path / "in"], grid, tmp_path / "out")
        for file, image in zip(files, images, strict=True):
            np.testing.assert_array_equal(read_image(file).pixels, Undistorter(grid)(image, 65535.0))

    def test_a_run_of_another_size_or_without_frames_leaves_no_folder(self, grid: GridMap, tmp_path: Path) -> None:
        place = folder_of(tmp_path / "in", [frames(1)[0][:100]], ".png")
        with pytest.raises(UnusableInputError, match="150 x 100 pixels, the map is of 150 x 120"):
            undistort([place], grid, tmp_path / "out")
        paths = [folder_of(tmp_path / "good", frames(1), ".png"), video(tmp_path / "run.avi", [])]
        with pytest.raises(ImageError, match="no frames"):
            undistort(paths, grid, tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_what_is_no_run_is_refused(self, grid: GridMap, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        (tmp_path / "text.avi").write_text("no video")
        folder_of(tmp_path / "runs", [], ".dcm")
        dicom_run(tmp_path / "runs" / "a.dcm", frames(2))
        for name, message in (
            ("empty", "0 images"),
            ("text.avi", "neither an image nor a video"),
            ("runs", "DICOM runs"),
            ("missing", "not a file"),
        ):
            with pytest.raises(UnusableInputError, match=message):
                UndistortedRun.of(tmp_path / name, 1)
