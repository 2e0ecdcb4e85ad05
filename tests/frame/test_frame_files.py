"""Frame files: plates, solids and the plate on the detector are read as they were written; bad files are refused."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.errors import FrameError, UnusableInputError
from sightline.frame import Fiducial, Frame, FrameView, InUse, Plate, Tolerances

number = st.floats(-1e4, 1e4)
name = st.text("abcXYZ019_.:+/-", min_size=1, max_size=12)


@st.composite
def frames(draw) -> Frame:
    sizes = draw(st.lists(st.tuples(st.integers(4, 6), st.integers(4, 6)), min_size=1, max_size=3))
    count = sum(sum(pair) for pair in sizes)
    ids = draw(st.lists(name, min_size=count, max_size=count, unique=True))
    views = draw(st.lists(name, min_size=len(sizes), max_size=len(sizes), unique=True))
    fiducial = st.builds(
        Fiducial,
        id=st.just("?"),
        xyz_mm=st.tuples(number, number, number),
        diameter_mm=st.floats(1e-3, 100),
        datum=st.booleans(),
        shape=st.sampled_from(["ball", "washer"]),
    )
    queue = iter([dataclasses.replace(draw(fiducial), id=i) for i in ids])
    plates = [[Plate(tuple(next(queue) for _ in range(n))) for n in pair] for pair in sizes]
    sd = st.floats(0, 1)
    root = np.random.default_rng(draw(st.integers(0, 99))).normal(size=(3 * count, 4))
    stated = draw(st.sampled_from(["nothing", "tolerances", "covariance"]))
    return Frame(
        name=draw(name),
        views={view: FrameView(*pair) for view, pair in zip(views, plates, strict=True)},
        serial=draw(st.none() | st.text(max_size=20)),
        measured_on=draw(st.none() | st.dates().map(lambda day: day.isoformat())),
        temperature_c=draw(st.none() | st.floats(-50, 200)),
        tolerances=draw(st.builds(Tolerances, sd, sd, sd, sd, sd)) if stated == "tolerances" else None,
        covariance_mm2=root @ root.T if stated == "covariance" else None,
    )


@settings(deadline=None, max_examples=30)
@given(frames())
def test_a_frame_survives_its_file(frame):
    again = Frame.from_json(frame.to_json())
    for field in dataclasses.fields(Frame):
        if field.name != "covariance_mm2":
            assert getattr(again, field.name) == getattr(frame, field.name)
    assert (again.covariance_mm2 is None) == (frame.covariance_mm2 is None)
    if frame.covariance_mm2 is not None:
        np.testing.assert_array_equal(again.covariance_mm2, frame.covariance_mm2)


BLOCK, DETECTOR = Frame.load("block60"), Frame.load("block40+detector-plate")
BEAD = Tolerances(0.03, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "frame",
    [
        *(Frame.load(name) for name in ("gamma", "biplane", "stereo", "block60")),
        *(replace(frame, serial="7", tolerances=BEAD, in_use=InUse(4.0, 0.001, 12.5)) for frame in (BLOCK, DETECTOR)),
    ],
)
def test_frames_survive_a_file_on_disk(tmp_path, frame):
    frame.save(tmp_path / "frame.json")
    again = Frame.load(str(tmp_path / "frame.json"))
    for name in ("key", "views", "solid", "detector", "tolerances", "in_use", "fingerprint"):
        assert getattr(again, name) == getattr(frame, name)
    assert (b'"detector"' in frame.to_json()) == (frame.detector is not None)


def test_every_view_shows_the_balls_of_a_solid_which_has_no_plates():
    gamma = Frame.load("gamma")
    assert BLOCK.fiducials_of("pa") == BLOCK.fiducials_of("oblique") == BLOCK.fiducials
    assert DETECTOR.fiducials_of("any") == DETECTOR.solid.fiducials + DETECTOR.detector.fiducials
    assert (BLOCK.rows("pa"), DETECTOR.rows("any")) == (slice(0, 3 * 16), slice(0, 3 * (14 + 69)))
    assert gamma.fiducials_of("pa") == gamma.view("pa").fiducials
    assert gamma.fiducials == gamma.fiducials_of("pa") + gamma.fiducials_of("lateral")
    with pytest.raises(FrameError, match="a solid without plates"):
        BLOCK.view("pa")


def test_a_plate_is_added_to_a_solid():
    both = replace(BLOCK, covariance_mm2=1e-4 * np.eye(48)).with_plate()
    assert both.name == "block60+detector-plate" and both.covariance_mm2.shape == (3 * 85, 3 * 85)
    np.testing.assert_allclose(np.diag(both.covariance_mm2)[[0, 47, 48, -1]], [1e-4, 1e-4, 4e-4, 4e-4])
    with pytest.raises(FrameError, match="has plates of its own"):
        Frame.load("gamma").with_plate()
    with pytest.raises(FrameError, match="both have a ball 'b1'"):
        DETECTOR.with_plate(Plate(DETECTOR.solid.fiducials))


GAMMA_TOLERANCES = {"sd_mm": {"bead": 0.02, "plate": 0.05}, "sd_rad": {"plate": 0.0, "arm": 0.0}}
IN_USE = {"warmer_k": 1.0, "water_share": 0.001, "drape_n": 1.0}


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("block60", lambda d: d.pop("solid"), "give the plates of one view or more"),
        ("block60", lambda d: d.update(views=json.loads(Frame.load("gamma").to_json())["views"]), "not both"),
        ("block60", lambda d: d.update(solid=d["solid"][:5]), "has 5 beads"),
        ("block60", lambda d: d.update(sd_rad={"plate": 0.0, "arm": 0.0}), "no plates and no arms"),
        ("block60", lambda d: d.update(sd_mm={"bead": 0.02, "plate": 0.0, "arm": 0.0}), "no plates and no arms"),
        ("block60", lambda d: d["solid"].append(d["solid"][0]), "occurs twice"),
        (DETECTOR.name, lambda d: d.pop("solid"), "plates of one view"),
        (DETECTOR.name, lambda d: d.update(detector=d["detector"][:11]), "too few entries"),
        (DETECTOR.name, lambda d: d["detector"][0].update(id="b1"), "'b1' occurs twice"),
        ("gamma", lambda d: d.update(detector=json.loads(DETECTOR.to_json())["detector"]), 'goes with a "solid"'),
        ("gamma", lambda d: d.update(GAMMA_TOLERANCES), r"sd_mm\.arm is missing"),
        ("gamma", lambda d: d.update(in_use=IN_USE | {"warmer_k": -1}), "in_use"),
        ("gamma", lambda d: d.update(in_use={"warmer_k": 5}), "in_use"),
        ("gamma", lambda d: d.update(in_use=IN_USE | {"water_share": 0.5}), "in_use"),
        ("gamma", lambda d: d.update(in_use=IN_USE | {"wind": 3}), "in_use"),
    ],
)
def test_impossible_frames_are_refused(name, change, words):
    document = json.loads(Frame.load(name).to_json())
    change(document)
    with pytest.raises(FrameError, match=words):
        Frame.from_json(json.dumps(document).encode())


@pytest.fixture(scope="module")
def document() -> dict:
    """A small frame as its file has it, six balls a plate."""

    def ball(plate: str, i: int, height: float) -> dict:
        return {"id": f"{plate}-{i}", "xyz": [20.0 * (i % 3), 20.0 * (i // 3), height], "diameter": 3.0, "datum": i < 3}

    heights = {"xrii": 300.0, "source": 150.0}
    views = {
        view: {role: [ball(f"{view}-{role}", i, height) for i in range(6)] for role, height in heights.items()}
        for view in ("pa", "lateral")
    }
    return {"name": "small", "units": "mm", "views": views}


def edited(document: dict, path: list, value: object) -> bytes:
    changed = inner = json.loads(json.dumps(document))
    for step in path[:-1]:
        inner = inner[step]
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return json.dumps(changed).encode()


FIRST = ["views", "pa", "xrii", 0]
SD = {"bead": 0.02, "plate": 0.05, "arm": 0.1}
NOT_SYMMETRIC = (np.eye(72) + np.diag(np.full(71, 0.5), 1)).tolist()
NEGATIVE = np.diag(np.r_[-1.0, np.ones(71)]).tolist()


def test_the_small_frame_is_good(document):
    frame = Frame.from_json(edited(document, ["serial"], "7"))
    assert frame.key == "small/7"
    assert frame.tolerances is None
    assert frame.effective_tolerances == Tolerances()


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["units"], "cm", "units is 'cm'; convert"),
        (["units"], None, "units is missing"),
        (["name"], "", "name must be 1 to 64"),
        (["views"], {}, "give the plates of one view or more"),
        (["view"], {}, "view is not a key of the frame file"),
        (["views", "pa", "source"], None, r"views\.pa\.source is missing; add it"),
        (["views", "pa", "xrii"], [], r"views\.pa\.xrii has too few entries"),
        ([*FIRST, "id"], "lateral-source-3", "'lateral-source-3' occurs twice"),
        ([*FIRST, "id"], "a,b", "must be 1 to 64"),
        ([*FIRST, "diameter"], 0, "diameter is 0; .* above zero"),
        ([*FIRST, "diameter"], "3", "is not a number; write it without quotes"),
        ([*FIRST, "xyz"], [1.0, 2.0], "has too few entries|is missing"),
        ([*FIRST, "xyz"], [1.0, 2.0, 3.0, 4.0], "too many entries"),
        ([*FIRST, "xyz", 2], float("nan"), "NaN is not a number; leave out the ball"),
        ([*FIRST, "xyz", 2], 1e300, "less than or equal to 10000"),
        ([*FIRST, "shape"], "cube", "'ball' or 'washer'"),
        ([*FIRST, "datum"], "yes", "boolean"),
        ([*FIRST, "radius"], 1.5, "radius is not a key"),
        (["sd_mm"], SD, 'both "sd_mm" and "sd_rad"'),
        (["sd_mm"], {"bead": 0.02}, r"sd_mm\.plate is missing"),
        (["sd_mm"], SD | {"bead": -0.1}, "greater than or equal to 0"),
        (["measured_on"], "yesterday", "measured_on"),
        (["covariance_mm2"], [[1.0]], "must be 72 x 72"),
        (["covariance_mm2"], [*np.eye(72).tolist()[:-1], [0.0]], "must be 72 x 72"),
        (["covariance_mm2"], NOT_SYMMETRIC, "not symmetric"),
        (["covariance_mm2"], NEGATIVE, "not positive semi-definite"),
    ],
)
def test_bad_frames_are_refused_with_what_to_do(document, path, value, words):
    with pytest.raises(FrameError, match=words):
        Frame.from_json(edited(document, path, value))


def test_tolerances_or_a_covariance_but_not_both(document):
    both = document | {"sd_mm": SD, "sd_rad": {"plate": 1e-4, "arm": 1e-4}, "covariance_mm2": np.eye(72).tolist()}
    with pytest.raises(FrameError, match="replaces the tolerances"):
        Frame.from_json(json.dumps(both).encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        (b'{"name": "x", "units": ', "not JSON"),
        (b"[]", "object"),
        (b"[" * 100_000, "not JSON"),
        (b'{"name": ' + b"1" * 5_000 + b"}", "not JSON"),
        (b'{"name": "a", "name": "b"}', "'name' occurs twice"),
        (b'{"name": "a", "temperature_c": 1e999}', "temperature_c is not a finite number"),
    ],
)
def test_files_that_are_no_frame(tmp_path, text, words):
    (tmp_path / "frame.json").write_bytes(text)
    with pytest.raises(FrameError, match=words) as caught:
        Frame.load(tmp_path / "frame.json")
    assert str(caught.value).startswith("frame.json: ")


def test_a_file_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("sightline.frame.document.MAX_JSON_BYTES", 1 << 20)
    (tmp_path / "frame.json").write_bytes(b" " * ((1 << 20) + 1))
    with pytest.raises(FrameError, match="larger than 1 MiB"):
        Frame.load(tmp_path / "frame.json")


@pytest.mark.parametrize("source", ["gama", "no/such.json", "."])
def test_an_unknown_name_is_listed_with_the_known_ones(source):
    with pytest.raises(FrameError, match="gamma, biplane, stereo"):
        Frame.load(source)


def test_a_frame_that_could_not_be_loaded_is_not_written(tmp_path):
    frame = dataclasses.replace(Frame.load("gamma"), covariance_mm2=np.eye(3))
    with pytest.raises(FrameError, match="must be 678 x 678"):
        frame.save(tmp_path / "frame.json")
    assert list(tmp_path.iterdir()) == []


def test_an_old_file_stays_where_the_new_one_cannot_be_written(tmp_path):
    with pytest.raises(UnusableInputError, match="cannot write"):
        Frame.load("gamma").save(tmp_path / "no" / "frame.json")
