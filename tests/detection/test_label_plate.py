"""Labels of a plate on the detector and of the block behind it, from detections as points."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.calibration import calibrate
from sightline.detection import Detections, label
from sightline.errors import CalibrationRefusedError, LabellingRefusedError
from sightline.frame import Frame, Plate
from sightline.twin import draw_setup
from sightline.twin.xray.setup import shadow_radius_px

FRAME = Frame.load("block40+detector-plate")
SD_PX = 0.15


def _scene(seed, *, hidden=0.0, false=0, mirrored=False, without=()):
    """Detections of the PA image in random order, and the id of each, None for a false one."""
    rng = np.random.default_rng(seed)
    setup = draw_setup(rng, FRAME)
    view, beads = setup.views["pa"], setup.frame_in("pa").fiducials
    xyz = np.array([bead.xyz_mm for bead in beads])
    uv = view.project(xyz)
    radius = shadow_radius_px(view, xyz, np.array([bead.diameter_mm / 2 for bead in beads]))
    kept = view.in_field(uv, radius) & (rng.random(len(uv)) >= hidden)
    kept &= np.array([bead.id not in without for bead in beads])
    angle, reach = rng.uniform(0, 2 * np.pi, false), 480.0 * np.sqrt(rng.random(false))
    stray = view.chain.centre_px + np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    uv = np.concatenate([uv[kept] + SD_PX * rng.standard_normal((kept.sum(), 2)), stray])
    radius = np.concatenate([radius[kept], rng.choice(radius, false)]) * np.exp(0.02 * rng.standard_normal(len(uv)))
    names = [bead.id for bead, one in zip(beads, kept, strict=True) if one] + [None] * false
    order = rng.permutation(len(uv))
    if mirrored:
        uv[:, 0] = view.chain.shape[1] - 1 - uv[:, 0]
    noise = np.broadcast_to(SD_PX**2 * np.eye(2), (len(uv), 2, 2))
    found = Detections(uv[order], radius[order], noise, ("ball",) * len(uv), -np.ones(len(uv)), view.chain.shape)
    return found, [names[k] for k in order]


def _wrong(seen, detections, names):
    """How many labels are wrong."""
    at = {tuple(uv): name for uv, name in zip(detections.uv_px, names, strict=True)}
    return sum(at[tuple(uv)] != name for uv, name in zip(seen.uv_px, seen.ids, strict=True))


@pytest.mark.parametrize(("hidden", "false"), [(0.0, 0), (0.2, 20)])
def test_plate_and_block_are_labelled_and_none_wrongly(hidden, false):
    """12 scenes: two thirds of the balls shown are labelled, and no ball of the block is another one."""
    for seed in range(12):
        detections, names = _scene(seed, hidden=hidden, false=false)
        seen = label(detections, FRAME, "pa")
        assert not _wrong(seen, detections, names) and not seen.mirrored
        shown = [name for name in names if name is not None]
        of_block = [name for name in shown if name in FRAME.solid.ids]
        assert len(seen) > 0.67 * len(shown)
        assert sum(name in FRAME.solid.ids for name in seen.ids) >= min(9, 0.8 * len(of_block))


def test_a_mirrored_display_is_seen_as_such():
    detections, names = _scene(20, mirrored=True)
    seen = label(detections, FRAME, "pa")
    assert seen.mirrored and not _wrong(seen, detections, names)


def test_half_a_plate_is_enough():
    """The plate's rows 6 to 9 lie outside the field; the datums of rows 1 and 3 are left."""
    gone = [name for name in FRAME.detector.ids if int(name.split("-")[1]) > 5]
    detections, names = _scene(21, without=gone)
    seen = label(detections, FRAME, "pa")
    assert not _wrong(seen, detections, names) and 12 <= len(seen) <= len(names)


@pytest.mark.parametrize(
    ("without", "why"),
    [
        (FRAME.detector.ids, "datum markers of the plate on the detector"),
        (FRAME.solid.ids, "beads were found, and 6 of the solid|lie as balls of this solid|to be chance"),
        (FRAME.solid.ids[5:], "beads were found, and 6 of the solid|lie as balls of this solid|to be chance"),
        ([f.id for f in FRAME.detector.fiducials if f.datum], "plate on the detector"),
    ],
    ids=["no plate", "no block", "five balls of the block", "no datum"],
)
def test_what_is_missing_is_refused(without, why):
    detections, _ = _scene(22, without=without, false=3)
    with pytest.raises(LabellingRefusedError, match=why):
        label(detections, FRAME, "pa")


def test_a_plate_of_a_mirrored_file_is_labelled_and_not_calibrated():
    """The datums are those of the plate's mirror image: the plate seems to be on back to front."""
    other = {f"d-{row}-{10 - column}" for row, column in ((1, 3), (1, 6), (3, 2), (6, 8), (9, 4), (9, 6))}
    plate = tuple(
        replace(f, datum=f.id in other, diameter_mm=3.0 if f.id in other else 2.0) for f in FRAME.detector.fiducials
    )
    frame = replace(FRAME, detector=Plate(plate))
    detections, names = _scene(23)
    seen = label(detections, frame, "pa")
    assert not seen.mirrored and _wrong(seen, detections, names) > 40
    with pytest.raises(CalibrationRefusedError, match="the right way round"):
        calibrate(seen, frame)
