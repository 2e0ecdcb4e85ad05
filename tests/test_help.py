"""`help()` of every public name has an example, and the examples run on what `sightline demo` writes."""

import doctest
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot
from tests.worked import Worked

import sightline as sl
from sightline.calibration.exchange.formats import write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.saved import document

MATRIX = np.array([[5000.0, 0.0, 512.0, 3e5], [0.0, 5000.0, 512.0, 3e5], [0.0, 0.0, 1.0, 600.0]])
NAMES = [name for name in sl.__all__ if name != "__version__"]


@pytest.fixture(scope="module")
def folder(worked: Worked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the demo writes, under out/demo; check images and a view of another program beside it."""
    out = tmp_path_factory.mktemp("help")
    shutil.copytree(worked.demo, out / "out" / "demo")
    views = [document(view, source="") for view in worked.views]
    (out / "out" / "demo" / "views.json").write_text(json.dumps(views))
    sl.save(worked.plan.trajectory, out / "out" / "demo" / "trajectory.json")
    for image in worked.check:
        shutil.copy(image, out)
    for name, data in write_view(Pinhole.of_matrix(MATRIX, "pa"), "opencv").items():
        (out / name).write_bytes(data)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_help_runs(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    text = getattr(sl, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, {"sl": sl, "np": np}, name, None, None)
    assert example.examples, f"help(sl.{name}) has no example"
    said: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=said.append)
    pyplot.close("all")
    assert not said, "".join(said)


def test_dir_lists_the_public_names_and_the_rooms_that_pages_use() -> None:
    pages = "".join(page.read_text() for page in (Path(__file__).parents[1] / "docs").rglob("*.md"))
    rooms = set(re.findall(r"\bfrom sightline\.([a-z_]+)", pages)) | set(re.findall(r"\bsl\.([a-z_]+)\.", pages))
    modules = {name for name in rooms if (Path(sl.__file__).parent / name).is_dir() or name == "errors"}
    assert modules <= set(dir(sl))
    assert {"frame", "twin", "planning"} <= modules | set(dir(sl))
    assert set(sl.__all__) <= set(dir(sl))


@pytest.mark.slow
def test_a_room_is_an_attribute_and_comes_when_it_is_used() -> None:
    program = "import sys, sightline as sl; before = 'sightline.planning' in sys.modules; "
    program += "sl.planning.PROCEDURES; sl.twin; print(before, 'numba' in sys.modules, sl.frame.Frame is sl.Frame)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.split()[::2] == ["False", "True"]
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = sl.nonsense


@pytest.mark.slow
def test_a_view_of_an_array_needs_no_pydicom_no_pydantic_and_no_geometry_of_scipy() -> None:
    """They take a fifth of the time and of the memory of a first view; an import at the top of a module fails this."""
    program = "import sys, numpy, sightline as sl; sl.Frame.load('gamma'); sl.Radiograph(numpy.ones((64, 64)), 1.0); "
    program += "import sightline.detection, sightline.calibration; "
    program += "print(*sorted({'pydicom', 'pydantic', 'scipy.spatial'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)  # noqa: S603
    assert not done.stdout.strip()
