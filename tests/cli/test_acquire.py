"""`sightline acquire`: images go into a case, names stay out of what is printed, Ctrl-C ends it well."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
from pydicom import dcmread
from pynetdicom import AE
from tests.systems import needs_posix

from sightline.case.acquire import robot
from sightline.case.journal import Case
from sightline.case.stages import image_of
from sightline.imaging import Radiograph, write_dicom
from sightline.robot.igtl import Image, Message, encode


def image(seed: int) -> Radiograph:
    return Radiograph(np.random.default_rng(seed).integers(0, 4096, (32, 40), dtype=np.uint16), 4095.0)


def started(*arguments: object) -> "subprocess.Popen[str]":
    """`sightline acquire ARGUMENTS` in a process of its own, with SIGINT ignored, as a script's `&` starts it."""
    command = [sys.executable, "-m", "sightline", "acquire", *map(str, arguments)]
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # noqa: S603
    finally:
        signal.signal(signal.SIGINT, before)


def said(process: "subprocess.Popen[str]", text: str) -> str:
    """The line of its notes that holds a text."""
    assert process.stderr is not None
    lines = iter(process.stderr.readline, "")
    return next(line for line in lines if text in line)


def test_a_folder_goes_into_a_new_case_and_again_into_the_same(run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for seed in range(3):
        write_dicom(image(seed), tmp_path / "in" / f"Doe^Jane {seed}.dcm")
    ran = run("acquire", "folder", tmp_path / "in", "--case", tmp_path / "case", "--json")
    assert ran.code == 0, ran.err
    assert [entry["number"] for entry in ran.document["entries"]] == [1, 2, 3]
    assert "Doe" not in ran.out + ran.err
    (tmp_path / "in" / "bad").write_bytes(b"x")
    ran = run("acquire", "folder", tmp_path / "in", "--case", tmp_path / "case")
    assert ran.code == 0
    assert ran.out.count("came again") == 3
    assert "file 4 (1 bytes)" in ran.err
    (tmp_path / "in" / "bad.png").write_bytes(b"x")
    ran = run("acquire", "folder", tmp_path / "in", "--case", tmp_path / "case")
    assert ran.code == 2
    assert "cannot be used: 1" in ran.err
    with Case.open(tmp_path / "case") as case:
        assert len(case.entries()) == 3
        assert case.problems == ()


def test_images_with_bright_balls_are_kept_as_they_came_and_read_inverted(run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    file = write_dicom(image(1), tmp_path / "in" / "a.dcm")
    ran = run("acquire", "folder", tmp_path / "in", "--case", tmp_path / "case", "--invert", "--json")
    assert ran.code == 0, ran.err
    with Case.open(tmp_path / "case", read_only=True) as case:
        entry = case.entry(1)
        assert case.original(entry.content["original"]).read_bytes() == file.read_bytes()
        read = image_of(case, entry)
    assert read.is_inverted
    np.testing.assert_array_equal(read.pixels, 4095 - image(1).pixels)
    assert run("case", "replay", tmp_path / "case", "--json").document["entries"][0]["outcome"] == "same to the bit"


def test_no_case_is_made_where_the_port_is_taken(run, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ran = run("acquire", "dicom", "--peer", "CARM@127.0.0.1", "--port", port, "--case", tmp_path / "case")
    assert ran.code == 2 and "cannot listen" in ran.err
    assert not (tmp_path / "case").exists()


@pytest.mark.slow
@needs_posix
def test_the_receiver_takes_an_image_and_a_signal_ends_it_with_its_result(tmp_path: Path) -> None:
    process = started("dicom", "--port", 0, "--peer", "CARM@127.0.0.1", "--case", tmp_path / "case")
    port = int(said(process, "listening at port").split("port ")[1].split()[0])
    ae = AE(ae_title="CARM")
    ae.add_requested_context("1.2.840.10008.5.1.4.1.1.12.1")
    association = ae.associate("127.0.0.1", port, ae_title="SIGHTLINE")
    assert association.send_c_store(dcmread(write_dicom(image(1), tmp_path / "a.dcm"))).Status == 0
    association.release()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert "entry 1: kept" in out
    assert "Traceback" not in err
    with Case.open(tmp_path / "case") as case:
        assert len(case.entries()) == 1


@pytest.mark.slow
@needs_posix
def test_a_watched_folder_takes_what_is_written_later(tmp_path: Path) -> None:
    """What is waited for is the process's own word and the case, however long a busy machine takes."""
    (tmp_path / "in").mkdir()
    process = started("folder", tmp_path / "in", "--case", tmp_path / "case", "--watch")
    said(process, "watching the folder")
    write_dicom(image(1), tmp_path / "in" / "a.dcm")
    with Case.open(tmp_path / "case", read_only=True) as case:
        while not case.last and process.poll() is None:
            time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "entry 1: kept" in out


def test_one_image_of_a_video_or_the_mean_of_several_is_taken(run, tmp_path: Path) -> None:
    file = tmp_path / "Doe^Jane.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (64, 48))
    still = np.random.default_rng(1).integers(60, 200, (48, 64), dtype=np.uint8)
    still = cv2.GaussianBlur(still, (0, 0), 2.0)
    for _ in range(6):
        writer.write(cv2.cvtColor(still, cv2.COLOR_GRAY2BGR))
    writer.release()
    into = ("--case", tmp_path / "case", "--json")
    ran = run("acquire", "video", file, *into, "--average", 4, "--crop", "8,8,40,32")
    assert ran.code == 0, ran.err
    (entry,) = ran.document["entries"]
    assert entry["settings"]["acquisition"]["averaged"] == 4
    assert entry["settings"]["acquisition"]["crop"] == [8, 8, 40, 32]
    assert "Doe" not in ran.out + ran.err
    assert run("acquire", "video", file, *into, "--average", 20).code == 2
    assert run("acquire", "video", file, *into, "--crop", "1,2,3").code == 2
    with Case.open(tmp_path / "case") as case:
        assert len(case.entries()) == 1


def test_one_image_of_an_openigtlink_peer_is_taken_and_a_stale_pose_is_refused(
    run, tmp_path: Path, monkeypatch
) -> None:
    def silent(*_: object, **__: object) -> robot.PoseNow:
        return robot.PoseNow((1.0,) * 5, 9.0)

    monkeypatch.setattr(robot.RobotWatch, "__enter__", lambda self: self)
    monkeypatch.setattr(robot.RobotWatch, "now", silent)
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        peer, _ = server.accept()
        peer.sendall(encode(Message(Image(image(1).pixels[None], np.eye(4)), "x")))
        peer.close()

    Thread(target=serve, daemon=True).start()
    port = server.getsockname()[1]
    ran = run("acquire", "igtl", f"127.0.0.1:{port}", "--case", tmp_path / "case", "--robot", "127.0.0.1:9", "--json")
    server.close()
    assert ran.code == 3, ran.err
    assert "pose stale" in ran.out
    (entry,) = ran.document["entries"]
    assert entry["settings"]["acquisition"]["robot"] == {"age_s": 9.0, "fresh": False, "joints": None}
