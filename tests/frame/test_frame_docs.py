"""What docs/frame-file.md shows is what the code takes and does."""

import re
from pathlib import Path

import numpy as np
import pytest

from sightline.common.checks import failed
from sightline.frame import Frame, Tolerances
from sightline.frame.check import check_frame
from sightline.frame.designs import BUILTIN, SOLIDS
from sightline.frame.solid_shape import FIELDS_MM, clear_beads, offset_mm

PAGE = (Path(__file__).parents[2] / "docs" / "frame-file.md").read_text(encoding="utf-8")


def test_the_example_is_a_frame():
    frame = Frame.from_json(re.search(r"```json\n(.*?)```", PAGE, re.DOTALL)[1].encode())
    assert frame.key == "bench-frame/03"
    assert frame.tolerances == Tolerances()
    assert {f.shape for f in frame.view("pa").source.fiducials} == {"ball", "washer"}
    assert [check.name for check in failed(check_frame(frame))] == ["plate-beads"]


def test_every_check_is_named():
    names = {check.name for frame in ("gamma", "block60") for check in check_frame(Frame.load(frame))}
    assert names <= set(re.findall(r"`([a-z-]+)`", PAGE))


@pytest.mark.parametrize("name", SOLIDS)
def test_the_table_of_blocks_is_theirs(name):
    solid = SOLIDS[name]
    diameters = [f.diameter_mm for f in solid.fiducials]
    clear = clear_beads(solid)
    reach = [offset_mm(solid, field) for field in FIELDS_MM.values()]
    cells = [
        name,
        " x ".join(f"{mm:g}" for mm in np.ptp(solid.xyz_mm, axis=0) + 7),
        f"{diameters.count(5.0)} and {diameters.count(3.0)}",
        f"{clear.mean():.1f}, {clear.min()}",
        *("does not fit" if mm < 0 else f"{mm:.0f} mm" for mm in reach),
    ]
    assert f"| `{' | '.join(cells)} |".replace(f"{name} |", f"{name}` |") in PAGE


def test_the_table_of_built_in_frames_is_theirs():
    for name in BUILTIN:
        cells = re.search(rf"^\| `{name}` \|(.*)\|$", PAGE, re.MULTILINE)[1].split("|")
        view = next(iter(Frame.load(name).views.values()))
        for cell, plate in ((cells[0], view.xrii), (cells[1], view.source)):
            rows, pitch, height = re.match(r" (\d+) x \d+ at ([\d.]+), ([+-]\d+) ", cell).groups()
            xyz = plate.xyz_mm
            assert (len(plate.ids), xyz[1, 0] - xyz[0, 0], xyz[0, 2]) == (int(rows) ** 2, float(pitch), float(height))
        (reach,) = [check.figure for check in check_frame(Frame.load(name)) if check.name == "wire-reach"]
        assert np.isclose(reach, float(cells[3]), atol=0.05)
