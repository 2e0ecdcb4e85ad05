"""Acquisition: C-STORE of a hundred images from a faulty sender, images per second, video, burnt-in annotations."""

import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from pydicom import Dataset, dcmread
from pynetdicom import AE
from pynetdicom.association import Association

from benchmarks.rows import Row
from sightline.case.acquire import Acquirer
from sightline.case.acquire.dicom import DicomReceiver, Peer
from sightline.case.journal import Case
from sightline.detection import detect
from sightline.imaging import Radiograph, write_dicom
from sightline.imaging.sources import VideoSource

IMAGES, SIDE = 100, 1024
XA = "1.2.840.10008.5.1.4.1.1.12.1"
GROUP = "acquisition"
FPS, SECONDS = 30, 6
REQUIRED_SHARE = 0.5  # of one core

# A sender that is killed while it sends an image.
_KILLED = """
import sys
from pydicom import dcmread
from pynetdicom import AE
ae = AE(ae_title="CARM")
ae.add_requested_context("1.2.840.10008.5.1.4.1.1.12.1")
association = ae.associate("127.0.0.1", int(sys.argv[1]), ae_title="SIGHTLINE")
image = dcmread(sys.argv[2])
print("sending", flush=True)
while True:
    association.send_c_store(image)
"""


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    images = IMAGES // 10 if quick else IMAGES
    with tempfile.TemporaryDirectory() as folder:
        return [*_store(Path(folder), images), *_video(Path(folder), 2 if quick else SECONDS), *_marks()]


def _store(folder: Path, images: int) -> list[Row]:
    rng = np.random.default_rng(1)
    files = [
        write_dicom(Radiograph(rng.integers(0, 4096, (SIDE, SIDE), dtype=np.uint16), 4095.0), folder / f"{k}.dcm")
        for k in range(images)
    ]
    with Case.create(folder / "case") as case:
        acquirer = Acquirer(case)
        receiver = DicomReceiver([Peer.parse("CARM@127.0.0.1")], port=0)
        with receiver, receiver.receiving(acquirer, lambda _: None):
            answered, peak = 0, _rss_mb()
            for k, file in enumerate(files):
                _misbehave(k, receiver.port, file)
                answered += _sent(receiver.port, dcmread(file))
                peak = max(peak, _rss_mb())
            held = {entry.content["pixels_sha256"] for entry in case.entries()}
            whole = all(check.passed for check in case.check())
    rate, cpu, floor = _rate(folder, files[: min(50, images)])
    required = f"{images} of {images}, the case whole"
    return [
        Row(
            GROUP,
            "C-STORE, the sender aborts, reconnects, sends garbage, is killed between images",
            f"{len(held)} of {images} kept, {answered} answered with success",
            required,
            met=len(held) == images and answered == images and whole,
        ),
        Row(GROUP, "memory of receiver and sender meanwhile, most", f"{peak:.0f} MB" if peak else "not measured"),
        Row(
            GROUP,
            f"C-STORE of {SIDE}² 16 bit on one association, each synced before its answer",
            f"{rate:.0f} images/s, {1e3 * cpu:.0f} ms of CPU an image, sender included",
            peer=f"write and sync alone {floor:.0f}/s",
        ),
    ]


def _misbehave(k: int, port: int, file: Path) -> None:
    """Do what a faulty sender does before image k: five kinds of fault in turn."""
    match k % 5:
        case 0:
            with _association(port) as association:
                association.abort()
        case 1:
            with socket.create_connection(("127.0.0.1", port)) as peer:
                peer.sendall(np.random.default_rng(k).bytes(3000))
        case 2:
            with _association(port) as association:
                sock = association.dul.socket
                assert sock is not None and sock.socket is not None
                half = struct.pack(">IBB", 60002, 1, 0) + bytes(60000)
                sock.socket.sendall(struct.pack(">BxI", 4, len(half)) + half)
                sock.socket.shutdown(socket.SHUT_RDWR)
        case 3:
            with socket.create_connection(("127.0.0.1", port)) as peer:
                peer.sendall(struct.pack(">BxI", 4, 0xFFFFFFF0) + bytes(5000))
        case 4:
            sender = subprocess.Popen(
                [sys.executable, "-c", _KILLED, str(port), str(file)], stdout=subprocess.PIPE, text=True
            )
            assert sender.stdout is not None
            sender.stdout.readline()
            time.sleep(0.01 * (k % 7))
            sender.send_signal(signal.SIGKILL)
            sender.wait()
            sender.stdout.close()


@contextmanager
def _association(port: int) -> Iterator[Association]:
    ae = AE(ae_title="CARM")
    ae.add_requested_context(XA)
    association = ae.associate("127.0.0.1", port, ae_title="SIGHTLINE")
    try:
        yield association
    finally:
        if association.is_established:
            association.release()


def _sent(port: int, image: Dataset) -> int:
    """Return 1 if the image is answered with success, within five attempts, else 0."""
    for _ in range(5):
        with suppress(Exception), _association(port) as association:
            if association.is_established and association.send_c_store(image).get("Status") == 0:
                return 1
        time.sleep(0.5)
    return 0


def _rate(folder: Path, files: list[Path]) -> tuple[float, float, float]:
    """Return images per second, CPU time per image, s, and the images per second of the disk alone."""
    images = [dcmread(file) for file in files]
    with (
        Case.create(folder / "rate") as case,
        DicomReceiver([Peer.parse("CARM@127.0.0.1")], port=0) as receiver,
        receiver.receiving(Acquirer(case), lambda _: None),
        _association(receiver.port) as association,
    ):
        began, used = time.perf_counter(), time.process_time()
        for image in images:
            assert association.send_c_store(image).Status == 0
        spent, used = time.perf_counter() - began, time.process_time() - used
    began = time.perf_counter()
    for k, file in enumerate(files):
        with (folder / f"{k}.copy").open("wb") as out:
            out.write(file.read_bytes())
            out.flush()
            os.fsync(out.fileno())
    return len(images) / spent, used / len(images), len(images) / (time.perf_counter() - began)


def _video(folder: Path, seconds: int) -> list[Row]:
    """Measure the share of a core for 30 frames per second of 1024², read from a file as fast as possible."""
    rng = np.random.default_rng(2)
    file = folder / "run.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (SIDE, SIDE))
    frames = [cv2.GaussianBlur(rng.integers(0, 255, (SIDE, SIDE, 1), dtype=np.uint8), (0, 0), 1.5) for _ in range(10)]
    for k in range(FPS * seconds):
        writer.write(cv2.cvtColor(frames[k % 10], cv2.COLOR_GRAY2BGR))
    writer.release()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    used = time.process_time()
    came = sum(1 for _ in VideoSource(str(file), deadline_s=30.0))
    used = time.process_time() - used
    bare = time.process_time()
    capture = cv2.VideoCapture(str(file))
    while capture.read()[0]:
        pass
    bare = time.process_time() - bare
    cv2.setNumThreads(threads)
    share = used / came * FPS
    return [
        Row(
            GROUP,
            f"video {SIDE}², MJPEG, at {FPS} frames a second",
            f"{100 * share:.0f} % of a core, {came} of {FPS * seconds} frames",
            f"every frame, {100 * REQUIRED_SHARE:.0f} %",
            f"OpenCV's decoding alone {100 * bare / came * FPS:.0f} %",
            share < REQUIRED_SHARE and came == FPS * seconds,
        )
    ]


def _marks() -> list[Row]:
    """Measure what the search for burnt-in annotations adds to a detection."""
    from sightline.frame import Frame
    from sightline.twin import draw_setup, hip_scene, render

    rng = np.random.default_rng(3)
    setup = draw_setup(rng, Frame.load("gamma"))
    pixels = render(setup, "pa", hip_scene(setup, rng).scene, rng)
    detect(pixels)
    looked, whole = [], []
    for _ in range(15):
        image = Radiograph(pixels.pixels, pixels.white)
        assert image.field_mask.any()
        began = time.thread_time()
        assert image.burnt_in is None
        looked.append(time.thread_time() - began)
        began = time.thread_time()
        detect(Radiograph(pixels.pixels, pixels.white))
        whole.append(time.thread_time() - began)
    return [
        Row(
            GROUP,
            f"looking for writing in an image of {SIDE}² without any",
            f"{1e3 * min(looked):.1f} ms of {1e3 * min(whole):.0f} ms for the whole detection",
        )
    ]


def _rss_mb() -> float:
    """Return the resident memory of this process, MB; 0 where unknown."""
    with suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024
    return 0.0  # not measured: there is no /proc
