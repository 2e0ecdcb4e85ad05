"""Video sources: cameras that hang or are unplugged, files, fields, averages, a live view."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sightline.errors import ImageError, MovedRefusedError, SourceError
from sightline.imaging import Radiograph, write_dicom
from sightline.imaging.average import average, movement
from sightline.imaging.defects import MOVED, comb, field_of
from sightline.imaging.sources import Run, VideoSource
from sightline.twin.xray.presets import preset
from sightline.twin.xray.render import Exposure

SIZE = (288, 384)


def scene(u_px: float = 0.0, part: tuple[slice, slice] | None = None, shape: tuple[int, int] = SIZE) -> np.ndarray:
    """Return a scene, 0 to 1, of balls and waves, displaced by `u_px` to the right, or only in a part."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    moved = np.full(shape, u_px)
    if part is not None:
        moved[:] = 0.0
        moved[part] = u_px
    x = u - moved
    from_ball = np.hypot(x % 50.0 - 25.0, v % 50.0 - 25.0)
    balls = 0.3 / (1 + np.exp((from_ball - 6.0) / 0.7))
    return 0.6 + 0.15 * np.sin(x / 17.0) * np.cos(v / 23.0) - balls


def noisy(light: np.ndarray, rng: np.random.Generator, quanta: float = 400.0) -> Radiograph:
    """Return a 12-bit image of a scene: blurred quanta."""
    counts = cv2.GaussianBlur(rng.poisson(light * quanta).astype(np.float32), (0, 0), 0.8)
    return Radiograph(np.clip(np.rint(counts * 3000 / quanta), 0, 4095).astype(np.uint16), 4095.0)


class Camera:
    """A scripted `cv2.VideoCapture`: each step is a picture, "hang" or "gone"; `plugged` in or not."""

    def __init__(self, script: list[Any], plugged: bool = True) -> None:
        self.script, self.plugged, self.opened = list(script), plugged, 0

    def __call__(self, place: object) -> "Camera":
        self.opened += 1
        return self

    def isOpened(self) -> bool:
        return self.plugged

    def get(self, what: int) -> float:
        return {cv2.CAP_PROP_SAR_NUM: 59.0, cv2.CAP_PROP_SAR_DEN: 54.0}.get(what, 0.0)

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(0.005)
        step = self.script.pop(0) if self.script else "gone"
        if isinstance(step, str):
            time.sleep(1.0 if step == "hang" else 0.0)
            return False, None
        return True, step

    def release(self) -> None:
        pass


def picture(value: int, shape: tuple[int, int] = SIZE) -> np.ndarray:
    out = np.full((*shape, 3), value, np.uint8)
    out[:20, :20] = 9
    return out


def source(camera: Camera, **options: Any) -> VideoSource:
    return VideoSource(0, opener=camera, **{"deadline_s": 0.3, "retry_s": 0.6, **options})


def test_a_camera_gives_numbered_grey_frames_with_its_aspect_and_crop() -> None:
    frames = iter(source(Camera([picture(value) for value in (50, 60, 70)] * 100), crop=(8, 4, 100, 90)))
    first, second = next(frames), next(frames)
    assert (first.number, second.number, first.source) == (1, 2, "video")
    assert first.image.shape == (90, 100)
    assert first.image.pixels[50, 50] in (50, 60, 70)
    assert first.image.pixels[0, 0] == 9
    assert first.image.white == 255
    assert first.pixel_aspect == pytest.approx(59 / 54)
    assert abs(first.stamped_s - time.time()) < 5


def test_a_camera_that_hangs_or_is_unplugged_is_opened_again_and_said() -> None:
    said: list[str] = []
    camera = Camera([picture(50), "hang", picture(60), "gone", picture(70), *[picture(70)] * 50])
    frames = iter(source(camera, tell=said.append))
    assert [next(frames).image.pixels[40, 40] for _ in range(3)] == [50, 60, 70]
    assert camera.opened == 3
    assert [text for text in said if "opening it again" in text and "back" not in text]
    assert any("is back" in text for text in said)


def test_a_camera_that_does_not_come_back_is_given_up_in_time() -> None:
    camera = Camera([picture(50)])
    frames = iter(source(camera))
    next(frames)
    camera.plugged = False
    began = time.monotonic()
    with pytest.raises(SourceError, match="did not come back within"):
        next(frames)
    assert time.monotonic() - began < 5.0
    with pytest.raises(SourceError, match="cannot be opened"):
        source(camera)


def test_a_picture_in_colour_and_a_crop_beyond_it_are_refused() -> None:
    red = picture(80)
    red[..., 2] = 200
    with pytest.raises(ImageError, match="in colour"):
        next(iter(source(Camera([red] * 9))))
    slightly = picture(80)
    slightly[..., 2] += 6  # an encoder's chroma
    assert next(iter(source(Camera([slightly] * 9)))).image.pixels[40, 40] in (80, 81, 82)
    with pytest.raises(ImageError, match="beyond the 384 x 288"):
        next(iter(source(Camera([picture(1)] * 9), crop=(300, 0, 100, 100))))


def test_no_thread_is_within_opencv_once_a_source_is_closed_or_python_exits(tmp_path: Path) -> None:
    """Python aborts if it exits while a thread is there, as after a picture in colour."""
    video = source(Camera([picture(50)] * 99))
    next(iter(video))
    video.close()
    assert not video._reader._thread.is_alive()
    file = tmp_path / "blue.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (640, 480))
    for _ in range(60):
        writer.write(np.full((480, 640, 3), (200, 20, 20), np.uint8))
    writer.release()
    script = "import sys; from sightline.imaging.sources import VideoSource; next(iter(VideoSource(sys.argv[1])))"
    program = [sys.executable, "-c", script, str(file)]
    ran = subprocess.run(program, check=False, capture_output=True, text=True)  # noqa: S603
    assert ran.returncode == 1
    assert ran.stderr.rstrip().endswith("choose the input that the C-arm's monitor has")


def test_every_frame_of_a_file_comes_and_then_it_ends(tmp_path: Path) -> None:
    file = tmp_path / "run.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, SIZE[::-1])
    assert writer.isOpened()
    for value in range(40, 80):
        writer.write(picture(value))
    writer.release()
    shown = [int(frame.image.pixels[100, 100]) for frame in VideoSource(str(file), deadline_s=20.0)]
    assert np.abs(np.diff(shown) - 1).max() <= 1
    assert len(shown) == 40
    with pytest.raises(SourceError):
        VideoSource(str(tmp_path / "absent.avi"), deadline_s=5.0)


def test_a_run_is_a_source_too(tmp_path: Path) -> None:
    image = noisy(scene(), np.random.default_rng(1))
    (frame,) = Run(write_dicom(image, tmp_path / "one.dcm"))
    np.testing.assert_array_equal(frame.image.pixels, image.pixels)


def test_still_images_are_averaged_and_the_noise_falls() -> None:
    rng = np.random.default_rng(2)
    images = [noisy(scene(), rng) for _ in range(16)]
    mean = average(images)
    assert mean.white == 65535
    alone, together = (
        np.std(image.pixels / image.white - scene() * 3000 / 4095, where=edges_off()) for image in (images[0], mean)
    )
    assert together < 0.4 * alone


def edges_off() -> np.ndarray:
    """Return the mask (H, W) of pixels that blur and clipping leave unchanged."""
    light = scene()
    return np.abs(cv2.GaussianBlur(light, (0, 0), 0.8) - light) < 0.002


@pytest.mark.parametrize("shift_px", [0.2, 0.7, 3.0, 11.0])
@pytest.mark.parametrize("part", [None, np.s_[64:192, 128:256]])
def test_a_movement_is_refused_with_its_size(shift_px: float, part: tuple[slice, slice] | None) -> None:
    rng = np.random.default_rng(4)
    quanta = 2000.0
    images = [noisy(scene(), rng, quanta), noisy(scene(shift_px, part), rng, quanta)]
    found = movement(*images)
    assert found.shift_px == pytest.approx(shift_px, rel=0.3, abs=0.05)
    if part is not None:
        assert found.uv_px is not None
        assert 100 < found.uv_px[0] < 280
    with pytest.raises(MovedRefusedError, match=r"image 3 (moved by|changed)"):
        average([images[0], noisy(scene(), rng, quanta), images[1]])


def test_noise_and_another_exposure_are_no_movement() -> None:
    rng = np.random.default_rng(5)
    for quanta in (60.0, 400.0, 5000.0):
        first = noisy(scene(), rng, quanta)
        assert all(movement(first, noisy(scene(), rng, quanta)).still for _ in range(5))
    assert movement(first, noisy(0.8 * scene(), rng)).still
    with pytest.raises(ImageError, match="cannot be compared"):
        movement(first, noisy(scene(shape=(100, 100)), rng))
    with pytest.raises(ImageError, match="no image"):
        average([])
    with pytest.raises(ImageError, match="different depth"):
        average([first, Radiograph((first.pixels >> 4).astype(np.uint8), 255.0)])


def read_out(rng: np.random.Generator, name: str, u_px: float = 0.0, quanta: float = 300.0) -> Radiograph:
    """Return a chain's image of the scene; for video, the second field is displaced by `u_px`."""
    chain = replace(preset(name), glare=0.0, white=4095)
    height, width = chain.shape

    def exposed(shift: float) -> Exposure:
        light = quanta * scene(shift, shape=(height, width))
        return Exposure(chain, light, light, np.ones((height, width), bool), 0.6, 3000 / quanta)

    return exposed(0.0).read_out(rng, exposed(u_px) if u_px else None)


def test_movement_between_the_fields_is_seen_and_one_field_is_free_of_it() -> None:
    rng = np.random.default_rng(6)
    still, moving = read_out(rng, "9in-pal"), read_out(rng, "9in-pal", 3.0)
    assert still.shape == (576, 768)
    assert comb(read_out(rng, "9in-1k")) < MOVED
    assert comb(still) < MOVED
    assert comb(read_out(rng, "9in-pal", quanta=15.0)) < MOVED  # at low dose too
    assert comb(read_out(rng, "9in-pal", 1.0)) > MOVED
    assert comb(moving) > 1.3
    fields = [field_of(moving, which) for which in (0, 1)]
    assert max(map(comb, fields)) < 0.6
    for which, field in enumerate(fields):
        np.testing.assert_array_equal(field.pixels[which::2], moving.pixels[which::2])
    assert movement(*fields).shift_px == pytest.approx(3.0, abs=0.4)
