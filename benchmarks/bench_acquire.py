"""Acquisition: C-STORE of a hundred images from a faulty sender, images per second, video."""

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

from benchmarks.harness import Rows
from sightline.case.acquire import Acquirer
from sightline.case.acquire.dicom import DicomReceiver, Peer
from sightline.case.journal import Case
from sightline.imaging import Radiograph, write_dicom
from sightline.imaging.sources import VideoSource

IMAGES, SIDE = 100, 1024
XA = "1.2.840.10008.5.1.4.1.1.12.1"
FPS, SECONDS = 30, 6
MAX_SHARE = 0.5  # of one core

# A sender that is killed while it sends an image.
_KILLED = """
import sys
from pydicom import dcmread
from pynetdicom import AE
ae = AE(ae_title="CARM")
ae.add_requested_context("1.2.840.10008.5.1.4.1.1.12.1")
link = ae.associate("127.0.0.1", int(sys.argv[1]), ae_title="SIGHTLINE")
image = dcmread(sys.argv[2])
print("sending", flush=True)
while True:
    link.send_c_store(image)
"""


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows = Rows("acquisition")
    with tempfile.TemporaryDirectory() as folder:
        _add_store(rows, Path(folder), IMAGES // 10 if quick else IMAGES)
        _add_video(rows, Path(folder), 2 if quick else SECONDS)
    return rows


def _add_store(rows: Rows, folder: Path, images: int) -> None:
    rng = np.random.default_rng(1)
    files = [
        write_dicom(Radiograph(rng.integers(0, 4096, (SIDE, SIDE), dtype=np.uint16), 4095.0), folder / f"{k}.dcm")
        for k in range(images)
    ]
    with Case.create(folder / "case") as case:
        acquirer, receiver = Acquirer(case), DicomReceiver([Peer.parse("CARM@127.0.0.1")], port=0)
        with receiver, receiver.receiving(acquirer, lambda _: None):
            answered = 0
            for k, file in enumerate(files):
                _misbehave(k, receiver.port, file)
                answered += _is_answered(receiver.port, dcmread(file))
            held = len({entry.content["pixels_sha256"] for entry in case.entries()})
            whole = all(check.passed for check in case.check())
    name = f"C-STORE of {images} images; between them the sender aborts, reconnects, sends garbage, is killed"
    value, met = f"{held} of {images} kept, {answered} answered with success", held == answered == images and whole
    rows.add(name, value, f"{images} of {images}, the case whole", met)
    rate, cpu_ms, floor = _rates(folder, files[: min(50, images)])
    name = f"C-STORE of {SIDE}² 16 bit on one association, each synced before its answer"
    value = f"{rate:.0f} images/s, {cpu_ms:.0f} ms of CPU an image, sender included"
    rows.add(name, value, peer=f"write and sync alone {floor:.0f}/s")


def _misbehave(k: int, port: int, file: Path) -> None:
    """Do what a faulty sender does before image k: five kinds of fault in turn."""
    match k % 5:
        case 0:
            with association(port) as link:
                link.abort()
        case 1:
            with socket.create_connection(("127.0.0.1", port)) as peer:
                peer.sendall(np.random.default_rng(k).bytes(3000))
        case 2:
            with association(port) as link:
                sock = link.dul.socket
                assert sock is not None and sock.socket is not None
                half = struct.pack(">IBB", 60002, 1, 0) + bytes(60000)
                sock.socket.sendall(struct.pack(">BxI", 4, len(half)) + half)
                sock.socket.shutdown(socket.SHUT_RDWR)
        case 3:
            with socket.create_connection(("127.0.0.1", port)) as peer:
                peer.sendall(struct.pack(">BxI", 4, 0xFFFFFFF0) + bytes(5000))
        case 4:
            command = [sys.executable, "-c", _KILLED, str(port), str(file)]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sender:
                assert sender.stdout is not None
                sender.stdout.readline()
                time.sleep(0.01 * (k % 7))
                sender.send_signal(signal.SIGKILL)


@contextmanager
def association(port: int) -> Iterator[Association]:
    """Yield an association of the sender CARM."""
    ae = AE(ae_title="CARM")
    ae.add_requested_context(XA)
    link = ae.associate("127.0.0.1", port, ae_title="SIGHTLINE")
    try:
        yield link
    finally:
        if link.is_established:
            link.release()


def _is_answered(port: int, image: Dataset) -> bool:
    """Return whether the image is answered with success, within five attempts."""
    for _ in range(5):
        with suppress(Exception), association(port) as link:
            if link.is_established and link.send_c_store(image).get("Status") == 0:
                return True
        time.sleep(0.5)
    return False


def _rates(folder: Path, files: list[Path]) -> tuple[float, float, float]:
    """Return images per second, CPU time per image, ms, and the images per second of the disk alone."""
    images = [dcmread(file) for file in files]
    with (
        Case.create(folder / "rate") as case,
        DicomReceiver([Peer.parse("CARM@127.0.0.1")], port=0) as receiver,
        receiver.receiving(Acquirer(case), lambda _: None),
        association(receiver.port) as link,
    ):
        began, used = time.perf_counter(), time.process_time()
        for image in images:
            assert link.send_c_store(image).Status == 0
        spent, used = time.perf_counter() - began, time.process_time() - used
    began = time.perf_counter()
    for k, file in enumerate(files):
        with (folder / f"{k}.copy").open("wb") as copy:
            copy.write(file.read_bytes())
            copy.flush()
            os.fsync(copy.fileno())
    return len(images) / spent, 1e3 * used / len(images), len(images) / (time.perf_counter() - began)


def _add_video(rows: Rows, folder: Path, seconds: int) -> None:
    """Measure the share of a core for 30 frames per second of 1024², read from a file as fast as possible."""
    rng, file = np.random.default_rng(2), folder / "run.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (SIDE, SIDE))
    frames = [cv2.GaussianBlur(rng.integers(0, 255, (SIDE, SIDE, 1), dtype=np.uint8), (0, 0), 1.5) for _ in range(10)]
    for k in range(FPS * seconds):
        writer.write(cv2.cvtColor(frames[k % 10], cv2.COLOR_GRAY2BGR))
    writer.release()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    started = time.process_time()
    came = sum(1 for _ in VideoSource(str(file), deadline_s=30.0))
    between = time.process_time()
    capture = cv2.VideoCapture(str(file))
    while capture.read()[0]:
        pass
    share, bare = ((end - begin) / came * FPS for begin, end in ((started, between), (between, time.process_time())))
    cv2.setNumThreads(threads)
    name, met = f"video {SIDE}², MJPEG, at {FPS} frames a second", share < MAX_SHARE and came == FPS * seconds
    value = f"{100 * share:.0f} % of a core, {came} of {FPS * seconds} frames"
    rows.add(name, value, f"{100 * MAX_SHARE:.0f} %", met, peer=f"OpenCV's decoding alone {100 * bare:.0f} %")
