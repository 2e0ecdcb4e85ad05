import pytest


@pytest.mark.slow  # tests/frame/test_workshop.py proves the drawings
def test_a_block_is_drawn_by_its_faces(run, tmp_path):
    ran = run("frame", "draw", "block30", "--out", tmp_path / "shop", "--clearance-mm", "0.2", "--json")
    assert ran.code == 0, ran.err
    assert sum(part["bores"] for part in ran.document["parts"]) == 12
    assert (tmp_path / "shop" / "solid.stl").exists()
