import pytest

from sightline.common.atomic import MANIFEST


@pytest.mark.slow
def test_draw_writes_the_workshop_folder(run, tmp_path):
    ran = run("frame", "draw", "stereo", "--out", tmp_path / "shop", "--json")
    assert ran.code == 0, ran.err
    assert [part["bores"] for part in ran.document["parts"]] == [49, 64, 49, 64]
    written = {str(file) for file in (tmp_path / "shop").iterdir() if file.name != MANIFEST}
    assert set(ran.document["files"]) == written
    assert len(written) == 21
    assert run("frame", "draw", "stereo", "--out", tmp_path / "quiet", "--quiet").out == ""
    assert "Bill of material" in run("frame", "draw", "gamma", "--out", tmp_path / "loud").out


def test_a_block_is_drawn_by_its_faces(run, tmp_path):
    ran = run("frame", "draw", "block30", "--out", tmp_path / "shop", "--clearance-mm", "0.2", "--json")
    assert ran.code == 0, ran.err
    assert sum(part["bores"] for part in ran.document["parts"]) == 12
    assert (tmp_path / "shop" / "solid.stl").exists()
    assert run("frame", "draw", "block30", "--out", tmp_path / "far", "--clearance-mm", "3").code == 2


@pytest.mark.parametrize(("frame", "words"), [("delta", "delta"), ("no.json", "no.json")])
def test_no_such_frame(run, tmp_path, frame, words):
    ran = run("frame", "draw", frame, "--out", tmp_path / "shop")
    assert ran.code == 2
    assert words in ran.err
    assert not (tmp_path / "shop").exists()


@pytest.mark.slow
def test_a_file_in_the_way_is_left_alone(run, tmp_path):
    (tmp_path / "shop").write_text("mine")
    assert run("frame", "draw", "gamma", "--out", tmp_path / "shop").code == 2
    assert (tmp_path / "shop").read_text() == "mine"
