"""Spoilt files: read, or refused by name; nothing else is ever raised, and no warning."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sightline.calibration.exchange.formats import FORMATS, read_view, write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.plan_file import PlanFile
from sightline.errors import SightlineError

CAMERA = np.array([[5000.0, 0, 500, 310000], [0, 5000, 480, 290000], [0, 0, 1, 620]])
GOOD = Pinhole.of_matrix(CAMERA, "pa", (64, 80), (0.2, 0.2))
NASTY = [b"", b"\x00", b"\xff", *b'nan 1e999 -1 0 1e308 null [] {} < &x; true "a"'.split()]


@st.composite
def spoilt(draw, data: bytes) -> bytes:
    """A piece of the text replaced by something that numbers and text should not be."""
    start = draw(st.integers(0, max(len(data) - 1, 0)))
    end = draw(st.integers(start, min(start + 24, len(data))))
    return data[:start] + draw(st.sampled_from(NASTY) | st.binary(max_size=6)) + data[end:]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_spoilt_view_is_read_or_refused(kind: str, tmp_path: Path) -> None:
    files = write_view(GOOD, kind)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)

    @settings(max_examples=60, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow])
    @given(st.data())
    def check(data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(files)))
        (tmp_path / name).write_bytes(data.draw(spoilt(files[name][:12_000])))
        target = name.replace(".mha", ".xml")
        try:
            view = read_view(tmp_path / target, name="pa").view()
            assert np.isfinite(view.matrix).all() and np.isfinite(view.focal_point_mm).all()
        except SightlineError:
            pass
        finally:
            (tmp_path / name).write_bytes(files[name])

    check()


def test_a_spoilt_plan_is_read_or_refused(plan_folder: Path, tmp_path: Path) -> None:
    document = json.loads((plan_folder / "plan.json").read_text())
    kept = {key: document[key] for key in ("go", "trajectory", "checks", "landmarks", "drawn")}
    text = json.dumps(kept).encode()

    @settings(max_examples=60, deadline=None, database=None)
    @given(spoilt(text))
    def check(data: bytes) -> None:
        (tmp_path / "plan.json").write_bytes(data)
        try:
            plan = PlanFile.read(tmp_path)
            assert np.isfinite(plan.points_mm).all()
            assert plan.statement
        except SightlineError:
            pass

    check()
