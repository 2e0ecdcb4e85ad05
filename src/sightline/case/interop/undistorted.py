"""Whole runs without distortion: folders of images, multi-frame DICOM and videos, each to the same kind of file.

A file appears under its name when it is complete; an interrupted run goes on with the first file that is missing.
Names are numbers, and DICOM has the neutral identity of exports: names of files may be patients'.
"""

import io
import json
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from struct import pack
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from pydicom import dcmread
from pydicom.uid import (
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
)

from sightline.calibration.maps.grid import GridMap, Undistorter
from sightline.case.interop.dicom import ExportIdentity, dataset
from sightline.common.atomic import sync_folder, write_whole
from sightline.common.bounded import MAX_FILE_BYTES, MAX_JSON_BYTES, MAX_RUN_BYTES, read_bounded
from sightline.errors import ImageError, UnusableInputError
from sightline.imaging import Radiograph, read_image
from sightline.imaging.dicom import file_bytes, fill, with_pixels
from sightline.imaging.files import frames_in, in_order
from sightline.imaging.formats import format_of_file
from sightline.imaging.sources import luma

RECORD = "undistorted.json"
MAX_FRAMES = 100_000  # [ours] of one run: an hour at 25 a second
_SAMPLE_BYTES = 2**16  # from the middle of each file, where the noise of two exposures differs [ours]
_WORKERS, _AHEAD = 2, 4  # threads, and frames that wait for their turn: a frame in memory is 2 MB [ours]
# Without compression and prediction: a PNG of 1024² at 16 bit takes 4 ms instead of 65, a TIFF 1 instead of 32
# [measured].
_UNFILTERED = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []
_PARAMETERS = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 0, *_UNFILTERED], ".tif": [cv2.IMWRITE_TIFF_COMPRESSION, 1]}
_SUFFIXES = {"TIFF": ".tif", "BMP": ".bmp", "NumPy": ".npy", "DICOM": ".dcm"}  # others become PNG, which has no loss
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class UndistortedRun:
    """One run: its files, how many frames they hold, and the names of its files in the new folder."""

    kind: Literal["images", "dicom", "video"]
    files: tuple[Path, ...]
    frames: int
    names: tuple[str, ...]

    @staticmethod
    def of(path: Path, number: int) -> "UndistortedRun":
        """Return the run of a folder of images, of one image, of a multi-frame DICOM file or of a video.

        Raises UnusableInputError, ImageError.
        """
        if path.is_dir():
            images = [file for file in in_order(path) if _format_name(file)]
            if not 0 < len(images) <= MAX_FRAMES:
                raise UnusableInputError(f"run {number} has {len(images)} images; give a folder of 1 to {MAX_FRAMES}")
            if any(frames_in(file) > 1 for file in images):
                raise UnusableInputError(f"the folder of run {number} holds DICOM runs; name these files themselves")
            names = [f"run-{number}/{k:05d}{_suffix(file)}" for k, file in enumerate(images, 1)]
            return UndistortedRun("images", tuple(images), len(images), tuple(names))
        if not _format_name(path):
            with _video(path) as capture:
                frames = int(max(1, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
            return UndistortedRun("video", (path,), frames, (f"run-{number}.avi",))
        frames = frames_in(path)
        return UndistortedRun("dicom" if frames > 1 else "images", (path,), frames, (f"run-{number}{_suffix(path)}",))

    def first(self) -> np.ndarray:
        """Return the pixels of the first frame. Raises ImageError, UnusableInputError."""
        if self.kind != "video":
            return read_image(self.files[0], 0 if self.kind == "dicom" else None).pixels
        with _video(self.files[0]) as capture:
            good, pixels = capture.read()
        if not good:
            raise ImageError(f"{self.files[0].name} has no frames; copy it again")
        return luma(pixels)

    def record(self) -> dict[str, Any]:
        """Return what a later call must find again to go on: sizes and a digest of samples, not names."""
        size, digest = sum(file.stat().st_size for file in self.files), sha256()
        for file in self.files:
            with file.open("rb") as stream:
                stream.seek(max(0, file.stat().st_size - _SAMPLE_BYTES) // 2)
                digest.update(stream.read(_SAMPLE_BYTES))
        described = {"kind": self.kind, "frames": self.frames, "bytes": size, "samples": digest.hexdigest()}
        return {**described, "files": list(self.names)}


def _format_name(file: Path) -> str:
    form = format_of_file(file) if file.is_file() else None
    return form.name if form else ""


def _suffix(file: Path) -> str:
    return _SUFFIXES.get(_format_name(file), ".png")


def undistort_runs(
    runs: list[UndistortedRun], grid: GridMap, folder: Path, advance: Callable[[], None]
) -> tuple[list[Path], int]:
    """Write the runs, resampled by the map, into a folder; return the files and how many were there.

    `advance` is called for each frame. Raises UnusableInputError where the folder holds other runs or another map's,
    and for frames of another size than the map's; ImageError. Where a first frame is refused, nothing is written.
    """
    undistorter = Undistorter(grid)
    for run in runs:
        undistorter(run.first(), 1.0)
    made_of = repr((grid.uv_px.tolist(), grid.index.tolist(), grid.hexagonal, grid.pitch_mm, grid.shape))
    record = {"map": sha256(made_of.encode()).hexdigest(), "spacing_mm": grid.spacing_mm}
    _begin(folder, {**record, "runs": [run.record() for run in runs]})
    created = datetime.fromtimestamp((folder / RECORD).stat().st_mtime).replace(microsecond=0)  # of an earlier call
    work = _Work(folder, undistorter, grid.spacing_mm, ExportIdentity("undistorted", created), advance)
    names = [name for run in runs for name in run.names]
    already = [name for name in names if (folder / name).exists()]
    for run in runs:
        work.images(run) if run.kind == "images" else work.whole(run)
    return [folder / name for name in names], len(already)


def _begin(folder: Path, record: dict[str, Any]) -> None:
    """Write the record of new runs, or check that it is that of the runs that are there."""
    file = folder / RECORD
    if file.exists():
        if json.loads(read_bounded(file, MAX_JSON_BYTES, UnusableInputError, "name another folder")) != record:
            raise UnusableInputError(f"{folder.name} holds other runs, or those of another map; name another folder")
        for part in folder.rglob(".*.part"):  # of a call that was killed
            part.unlink()
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UnusableInputError(f"{folder.name} is a file or holds other files; name a new folder")
    for name in [RECORD, *(name for run in record["runs"] for name in run["files"])]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(record, indent=1).encode())


def _ahead(workers: int, work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Yield the results in order, worked on ahead in threads: OpenCV, Pillow and files release Python's lock."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[_Result]] = deque()
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@dataclass(frozen=True, eq=False)
class _Work:
    """What undistorts the frames of runs into a folder. `identity`: of DICOM files."""

    folder: Path
    undistorter: Undistorter
    spacing_mm: float
    identity: ExportIdentity
    advance: Callable[[], None]

    def images(self, run: UndistortedRun) -> None:
        """Write the missing files of a run of single images."""
        for _ in _ahead(_WORKERS, self._image, zip(run.files, run.names, strict=True)):
            self.advance()

    def _image(self, item: tuple[Path, str]) -> None:
        file, target = item[0], self.folder / item[1]
        if target.exists():
            return
        image = read_image(file)
        pixels = self.undistorter(image.pixels, image.white)
        if target.suffix == ".dcm":
            data = self._header(image, item[1]) + pixels.tobytes() + b"\0" * (pixels.nbytes % 2)
        elif target.suffix == ".npy":
            np.save(buffer := io.BytesIO(), pixels)
            data = buffer.getvalue()
        else:
            data = cv2.imencode(target.suffix, pixels, _PARAMETERS.get(target.suffix, []))[1].tobytes()
        write_whole(target, data)

    def whole(self, run: UndistortedRun) -> None:
        """Write the one file of a run, unless it is there: under a hidden name until it is complete and on the disk."""
        target = self.folder / run.names[0]
        if target.exists():
            for _ in range(run.frames):
                self.advance()
            return
        scratch = target.with_name(f".part{target.suffix}")
        try:
            self._video(run, scratch) if run.kind == "video" else self._dicom(run, scratch)
            with scratch.open("rb+") as file:
                os.fsync(file.fileno())
            scratch.replace(target)
            sync_folder(target.parent)
        finally:
            scratch.unlink(missing_ok=True)

    def _dicom(self, run: UndistortedRun, scratch: Path) -> None:
        file, name = run.files[0], run.names[0]
        first = read_image(file, 0)
        if run.frames * first.pixels.nbytes > MAX_RUN_BYTES:
            raise UnusableInputError(f"{file.name} unpacks to more than {MAX_RUN_BYTES} bytes; divide it")

        def frame(index: int) -> bytes:
            image = read_image(file, index)
            return self.undistorter(image.pixels, image.white).tobytes()

        with scratch.open("wb") as stream:
            stream.write(self._header(first, name, run.frames, _frame_ms(file)))
            for data in _ahead(_WORKERS, frame, range(run.frames)):
                stream.write(data)
                self.advance()
            stream.write(b"\0" * (run.frames * first.pixels.nbytes % 2))

    def _header(self, image: Radiograph, part: str, frames: int = 1, frame_ms: float = 0.0) -> bytes:
        """Return a DICOM file up to its pixels: a multi-frame secondary capture. Raises ImageError."""
        if image.pixels.dtype not in (np.uint8, np.uint16):
            raise ImageError("DICOM holds whole numbers of 8 or 16 bits")
        kind, vr = (
            (MultiFrameGrayscaleByteSecondaryCaptureImageStorage, b"OB")
            if image.pixels.itemsize == 1
            else (MultiFrameGrayscaleWordSecondaryCaptureImageStorage, b"OW")
        )
        described = fill(
            dataset(self.identity, kind, "OT", part),
            ConversionType="WSD",
            InstanceNumber=int("".join(filter(str.isdigit, part))),
            PatientOrientation=None,
            ImageType=["DERIVED", "SECONDARY"],
            SeriesDescription="Sightline",
            DerivationDescription="Distortion removed by the map of a grid",
            NumberOfFrames=frames,
            PixelSpacing=[f"{self.spacing_mm:.10g}"] * 2,
            PixelSpacingCalibrationType="FIDUCIAL",
            PixelSpacingCalibrationDescription="mm in the plane of the grid",
            PresentationLUTShape="IDENTITY",
            RescaleIntercept=0,
            RescaleSlope=1,
            RescaleType="US",
            **({"FrameIncrementPointer": 0x00181063, "FrameTime": f"{frame_ms:.10g}"} if frame_ms else {}),
        )
        del with_pixels(described, image.pixels, int(image.white).bit_length()).PixelData
        length = frames * image.pixels.nbytes
        return file_bytes(described) + pack("<HH2sHI", 0x7FE0, 0x0010, vr, 0, length + length % 2)

    def _video(self, run: UndistortedRun, scratch: Path) -> None:
        """Write a video without loss: FFV1, 8 bit, grey."""

        def frame(_: int) -> np.ndarray | None:  # in one thread, one after another
            good, pixels = capture.read()
            return self.undistorter(luma(pixels), 255.0) if good else None

        with _video(run.files[0]) as capture:
            rate = capture.get(cv2.CAP_PROP_FPS) or 25.0
            width, height = (int(capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            if width % 2 or height % 2:  # OpenCV would cut a column or a row off
                raise UnusableInputError(f"a video of {width} x {height} pixels; give the frames as a folder of images")
            code, grey = cv2.VideoWriter.fourcc(*"FFV1"), [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
            writer = cv2.VideoWriter(str(scratch), cv2.CAP_FFMPEG, code, rate, (width, height), grey)
            try:
                if not writer.isOpened():
                    raise UnusableInputError("this OpenCV writes no FFV1 video; give the frames as a folder of images")
                written = 0
                for pixels in _ahead(1, frame, range(MAX_FRAMES)):
                    if pixels is None:
                        break
                    writer.write(pixels)
                    written += 1
                    self.advance()
            finally:
                writer.release()
        if written < run.frames:
            raise ImageError(f"{run.files[0].name} ends after {written} of {run.frames} frames; copy it again")


def _frame_ms(file: Path) -> float:
    """Return the time between the frames of a DICOM file; 0 where it does not state one."""
    try:
        header = dcmread(file, stop_before_pixels=True, specific_tags=["FrameTime", "CineRate"])
        return float(header.get("FrameTime") or 1000 / float(header.get("CineRate") or np.inf))
    except Exception:  # broken bytes may make pydicom raise anything; its messages may quote the patient
        return 0.0


@contextmanager
def _video(file: Path) -> Generator[Any]:
    """Open a video file. Raises UnusableInputError."""
    if not file.is_file() or file.stat().st_size > MAX_FILE_BYTES:
        raise UnusableInputError(
            f"{file.name} is not a file of up to {MAX_FILE_BYTES >> 30} GiB; name a folder or a file"
        )
    capture = cv2.VideoCapture(str(file.resolve()), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise UnusableInputError(f"{file.name} is neither an image nor a video that can be read")
        yield capture
    finally:
        capture.release()
