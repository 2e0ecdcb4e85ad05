"""Wrong beads, clicks, frames and patients, as measured points; nothing is rendered.

Wrong plans, clicked as they were meant, are in the study `wrong-plans`.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

import sightline as sl
from campaigns.campaign import Campaign, Damage, Ended
from campaigns.person import PICK_PX, Clicks, judged
from sightline.detection import Observations
from sightline.frame import Fiducial, Frame
from sightline.studies.scenes import VIEWS, measure
from sightline.twin import HipScene, SetUp, bead_images
from sightline.twin.anatomy.femur import draw_femur
from sightline.twin.objects.things import Scene
from sightline.twin.scenes.hip_scene import shown_setup
from sightline.twin.xray.setup import shadow_radius_px

BEAD_PX = 0.1  # physics.md, Centroid limit
# How much larger balls look, log, in an image: mean and s.d. over images; s.d. over balls [twin].
LARGER, EACH_LARGER = (0.010, 0.005), 0.02
UNSEEN = 2.0  # s.d.: a smaller difference is not evidence
WEAK = 5.0  # s.d.: more must be refused; checks fail at 3.3, one false alarm in a thousand, and share the evidence


@dataclass
class World:
    """One procedure as given to the program; a damage changes it. `hip` at rest, `moved` at the lateral image."""

    setup: SetUp
    hip: HipScene
    told: Frame
    observations: dict[str, Observations]
    clicks: Clicks
    moved: HipScene
    pick_sd_px: float = PICK_PX
    never_go: bool = False  # the intended plan itself is wrong
    noise: bool = True

    @staticmethod
    def draw(rng: np.random.Generator, *, noise: bool = True) -> "World":
        """Return a procedure without damage; without `noise`, everything is measured exactly. Raises SetUpError."""
        frame = Frame.load("gamma")
        side = str(rng.choice(["right", "left"]))
        femur = draw_femur(rng)
        setup, head = shown_setup(rng, frame, side, femur)
        hip = HipScene.of(Scene(), Scene(), femur, side, head)
        seen = {name: _with_radii(rng, setup, beads) for name, beads in measure(rng, setup, BEAD_PX).items()}
        if not noise:
            exact = {name: bead_images(setup, name, deepcopy(rng), sd_px=0.0) for name in VIEWS}
            seen = {n: Observations(n, ids, uv, seen[n].covariance_px2) for n, (ids, uv) in exact.items()}
        told = frame if noise else setup.true_frame
        return World(setup, hip, told, seen, Clicks.on(setup, hip, rng, noise=noise), hip, noise=noise)

    def end(self) -> Ended:
        """Return the verdict on the observations."""
        views = [sl.calibrate(self.observations[name], self.told, view=name) for name in VIEWS]
        ended = judged(self.clicks.plan(views, self.pick_sd_px), self.moved.wire_mm)
        if self.never_go and ended.how == "right":
            return Ended("wrong", "GO for a plan that no surgeon wants", ended.ratio)
        return ended

    def evidence(self) -> tuple[dict[str, np.ndarray], float]:
        """Return residuals in standard deviations, and the chi-square of the gaps of all clicked points together.

        Residuals of each bead against the others, by name, and of the head's radius between the views ("radius").
        """
        views = [sl.calibrate(self.observations[name], self.told, view=name) for name in VIEWS]
        uv = np.concatenate([self.clicks.wire, self.clicks.landmarks, self.clicks.head[:, None, :2]], axis=1)
        points = sl.reconstruct(views, uv, np.broadcast_to(self.pick_sd_px**2 * np.eye(2), (*uv.shape, 2)))
        assert points.gap_chi2 is not None
        residuals: dict[str, np.ndarray] = {}
        for view in views:
            left = view.residuals
            size = np.linalg.norm(left.leave_one_out_mm, axis=1)
            scaled = left.leave_one_out_mm * (left.sigma / np.maximum(size, 1e-12))[:, None]
            residuals |= dict(zip(left.ids, scaled, strict=True))
        away = [np.linalg.norm(points.xyz_mm[-1] - view.focal_point_mm) for view in views]
        residuals["radius"] = np.diff(self.clicks.head[:, 2] * away) / (self.pick_sd_px * np.hypot(*away))
        return residuals, points.gap_chi2

    def change_beads(self, name: str, **fields: Any) -> None:
        """Replace pixels or names of one view's beads."""
        self.observations[name] = replace(self.observations[name], **fields)

    def keep_beads(self, name: str, kept: np.ndarray) -> None:
        """Keep only some beads (N,) bool."""
        seen = self.observations[name]
        ids = tuple(np.array(seen.ids)[kept].tolist())
        fields = {key: getattr(seen, key)[kept] for key in ("uv_px", "covariance_px2", "radius_px")}
        self.change_beads(name, ids=ids, **fields)

    def move_wire(self, view: int, point: int, by_px: np.ndarray) -> None:
        """Move one click. `point`: 0 entry, 1 end."""
        wire = self.clicks.wire.copy()
        wire[view, point] += by_px
        self.clicks = replace(self.clicks, wire=wire)

    def reclick(self, hip: HipScene, rng: np.random.Generator, **at: HipScene) -> None:
        """Click on another hip, or on one that moved at the image of a view."""
        self.clicks = Clicks.on(self.setup, hip, rng, at, noise=self.noise)


def _with_radii(rng: np.random.Generator, setup: SetUp, seen: Observations) -> Observations:
    """Return beads with the radii of their shadows as images of the twin give them (calibration/lengths.py)."""
    known = {bead.id: bead for bead in setup.true_frame.fiducials_of(seen.view)}
    xyz, diameter = (np.array([getattr(known[i], what) for i in seen.ids]) for what in ("xyz_mm", "diameter_mm"))
    larger = np.exp(rng.normal(*LARGER) + EACH_LARGER * rng.standard_normal(len(seen)))
    return replace(seen, radius_px=larger * shadow_radius_px(setup.views[seen.view], xyz, diameter / 2))


Change = Callable[[World, np.random.Generator], None]


def damage(change: Change, *cause: str) -> Damage:
    """Return the class of one change."""

    def make(rng: np.random.Generator) -> Ended:
        again = deepcopy(rng)
        world = World.draw(rng)
        change(world, rng)
        ended = world.end()
        if ended.how != "wrong" or world.never_go:
            return ended
        sigma = apart(change, again)
        return replace(ended, how="unseen" if sigma < UNSEEN else "weak" if sigma < WEAK else "wrong")

    return Damage(make, cause)


def apart(change: Change, rng: np.random.Generator) -> float:
    """Return the difference of all observations of a damaged and the undamaged world, in standard deviations.

    Without noise: the residuals of beads, clicks and circles after fitting focal points, maps and points with a correct
    frame.
    """
    again = deepcopy(rng)
    right, wrong = World.draw(rng, noise=False), World.draw(again, noise=False)
    change(wrong, again)
    (beads, gaps), (others, opened) = right.evidence(), wrong.evidence()
    if beads.keys() != others.keys():
        return np.inf
    moved = [np.linalg.norm(others[name] - beads[name]) for name in beads]
    return float(np.linalg.norm([*moved, np.sqrt(max(opened - gaps, 0.0))]))


def nothing(world: World, rng: np.random.Generator) -> None:
    """Change nothing."""


def _view(rng: np.random.Generator) -> int:
    return int(rng.integers(2))


def _unit(rng: np.random.Generator, size: int) -> np.ndarray:
    vector = rng.standard_normal(size)
    return vector / np.linalg.norm(vector)


def exchanged_ids(world: World, rng: np.random.Generator) -> None:
    """Exchange the names of one to four pairs of neighbouring beads."""
    name = VIEWS[_view(rng)]
    seen = world.observations[name]
    ids = list(seen.ids)
    for _ in range(int(rng.integers(1, 5))):
        k = int(rng.integers(len(ids)))
        other = int(np.argsort(np.linalg.norm(seen.uv_px - seen.uv_px[k], axis=1))[int(rng.integers(1, 4))])
        ids[k], ids[other] = ids[other], ids[k]
    world.change_beads(name, ids=tuple(ids))


def displaced_beads(world: World, rng: np.random.Generator) -> None:
    """Displace one to ten beads by 0.3 to 20 px."""
    name = VIEWS[_view(rng)]
    uv = world.observations[name].uv_px.copy()
    hit = rng.choice(len(uv), int(rng.integers(1, 11)), replace=False)
    uv[hit] += np.exp(rng.uniform(np.log(0.3), np.log(20.0))) * rng.standard_normal((len(hit), 2))
    world.change_beads(name, uv_px=uv)


def understated_noise(world: World, rng: np.random.Generator) -> None:
    """Make beads 2 to 8 times noisier than stated, in both views."""
    factor = rng.uniform(2.0, 8.0) * BEAD_PX
    for name in VIEWS:
        uv = world.observations[name].uv_px
        world.change_beads(name, uv_px=uv + factor * rng.standard_normal(uv.shape))


def missing_beads(world: World, rng: np.random.Generator) -> None:
    """Remove up to three quarters of the beads, at random or on one side."""
    name = VIEWS[_view(rng)]
    uv = world.observations[name].uv_px
    order = rng.random(len(uv)) if rng.random() < 0.5 else uv @ _unit(rng, 2)
    world.keep_beads(name, order >= np.quantile(order, rng.uniform(0.1, 0.75)))


def torn(world: World, rng: np.random.Generator, *, keep: bool = True) -> None:
    """Shift all beads and clicks below a row through the wire by 1 to 40 px; remove the beads there unless `keep`."""
    view = _view(rng)
    name, by = VIEWS[view], np.array([rng.choice([-1, 1]) * np.exp(rng.uniform(0, np.log(40))), 0.0])
    row = rng.uniform(*np.sort(world.clicks.wire[view, :, 1]))

    def shown(uv: np.ndarray) -> np.ndarray:
        return uv + (uv[..., 1] > row)[..., None] * by

    world.change_beads(name, uv_px=shown(world.observations[name].uv_px))
    if not keep:
        world.keep_beads(name, world.observations[name].uv_px[:, 1] <= row)
    world.clicks = world.clicks.as_shown({name: shown})


def warped(world: World, rng: np.random.Generator) -> None:
    """Shear, stretch and rotate one image, which the map absorbs."""
    name = VIEWS[_view(rng)]
    matrix = np.eye(2) + rng.uniform(-0.08, 0.08, (2, 2))

    def shown(points: np.ndarray) -> np.ndarray:
        return points @ matrix.T

    world.change_beads(name, uv_px=shown(world.observations[name].uv_px))
    world.clicks = world.clicks.as_shown({name: shown})


def views_exchanged(world: World, _: np.random.Generator) -> None:
    """Exchange the clicks of the images."""
    c = world.clicks
    world.clicks = replace(c, wire=c.wire[::-1], landmarks=c.landmarks[::-1], head=c.head[::-1], lines=c.lines[::-1])
    world.never_go = True


def row_column(world: World, _: np.random.Generator) -> None:
    """Give (v, u) instead of (u, v)."""
    c = world.clicks
    head = np.concatenate([c.head[:, 1::-1], c.head[:, 2:]], axis=1)
    world.clicks = replace(
        c, wire=c.wire[..., ::-1], landmarks=c.landmarks[..., ::-1], head=head, lines=c.lines[..., ::-1]
    )


def points_for_views(world: World, _: np.random.Generator) -> None:
    """Give (point, view) instead of (view, point), which has the same shape."""
    world.clicks = replace(world.clicks, wire=world.clicks.wire.swapaxes(0, 1))


def _along_curve(world: World, view: int, point: int) -> np.ndarray:
    """Return the unit vector (2,) along the matching curve of entry or end in this view."""
    this, other = (world.setup.views[VIEWS[k]] for k in (view, 1 - view))
    at = world.hip.wire_mm[point]
    ray = (at - other.focal_point_mm) / np.linalg.norm(at - other.focal_point_mm)
    step = np.diff(this.project(np.stack([at - ray, at + ray])), axis=0)[0]
    return step / np.linalg.norm(step)


def one_pick_off(world: World, rng: np.random.Generator) -> None:
    """Move one click 5 to 20 px across its matching curve, and at most as much along it."""
    view, point = _view(rng), _view(rng)
    along, by = _along_curve(world, view, point), rng.choice([-1, 1]) * rng.uniform(5, 20)
    world.move_wire(view, point, by * (np.array([-along[1], along[0]]) + rng.uniform(-1, 1) * along))


def one_pick_along(world: World, rng: np.random.Generator) -> None:
    """Move one click 5 to 20 px along its matching curve, which changes no gap."""
    view, point = _view(rng), _view(rng)
    world.move_wire(view, point, rng.choice([-1, 1]) * rng.uniform(5, 20) * _along_curve(world, view, point))


def careless(world: World, rng: np.random.Generator) -> None:
    """Give all clicks a noise of 2 to 4 px, with 0.5 px stated."""
    world.clicks = world.clicks.jittered(rng, rng.uniform(2.0, 4.0))


def landmark_off(world: World, rng: np.random.Generator) -> None:
    """Move a landmark in one image to another point, 8 to 60 px away."""
    marks = world.clicks.landmarks.copy()
    marks[_view(rng), int(rng.integers(marks.shape[1]))] += rng.uniform(8, 60) * _unit(rng, 2)
    world.clicks = replace(world.clicks, landmarks=marks)


def head_off(world: World, rng: np.random.Generator) -> None:
    """Move the head's circle by 20 to 60 px or scale it by 0.6 to 1.5 in one image; the wire stays correct."""
    head = world.clicks.head.copy()
    view = _view(rng)
    if rng.random() < 0.5:
        head[view, :2] += rng.uniform(20, 60) * _unit(rng, 2)
    else:
        head[view, 2] *= rng.choice([rng.uniform(0.6, 0.85), rng.uniform(1.18, 1.5)])
    world.clicks = replace(world.clicks, head=head)


def mirrored_frame(world: World, _: np.random.Generator) -> None:
    """Make the frame file left-handed: y changes its sign, names stay."""
    world.told = altered(world.told, lambda bead: (bead.xyz_mm[0], -bead.xyz_mm[1], bead.xyz_mm[2]))


def scaled_frame(world: World, rng: np.random.Generator) -> None:
    """Scale the frame file by 0.2 to 6 %; its balls are as stated."""
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.002, 0.06)
    world.told = altered(world.told, lambda bead: tuple(factor * c for c in bead.xyz_mm))


def shifted_plate(world: World, rng: np.random.Generator) -> None:
    """Shift one plate in the frame file by 0.2 to 2 mm."""
    name, plate, by = VIEWS[_view(rng)], str(rng.choice(["xrii", "source"])), rng.uniform(0.2, 2.0) * _unit(rng, 3)
    ids = set(getattr(world.told.view(name), plate).ids)
    world.told = altered(world.told, lambda bead: tuple(np.array(bead.xyz_mm) + (by if bead.id in ids else 0.0)))


def altered(frame: Frame, place: Callable[[Fiducial], tuple[float, ...]]) -> Frame:
    """Return a frame with its balls moved to `place`."""

    def moved(plate):
        return replace(plate, fiducials=tuple(replace(b, xyz_mm=tuple(map(float, place(b)))) for b in plate.fiducials))

    views = {n: replace(v, xrii=moved(v.xrii), source=moved(v.source)) for n, v in frame.views.items()}
    return replace(frame, views=views)


def moved_patient(world: World, rng: np.random.Generator) -> None:
    """Move the patient by 0.5 to 8 mm and up to 3° between the two images."""
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(0, 3)) * _unit(rng, 3))
    _move(world, rng, rng.uniform(0.5, 8.0) * _unit(rng, 3), turn)


def moved_in_plane(world: World, rng: np.random.Generator) -> None:
    """Move the patient by 0.5 to 8 mm in the plane of both beams, where the lines of sight still intersect."""
    pa, lateral = (world.hip.head_mm - world.setup.views[name].focal_point_mm for name in VIEWS)
    normal = np.cross(pa, lateral)
    across, angle = np.cross(normal, pa), rng.uniform(0.0, 2 * np.pi)
    aside = np.cos(angle) * pa / np.linalg.norm(pa) + np.sin(angle) * across / np.linalg.norm(across)
    _move(world, rng, rng.uniform(0.5, 8.0) * aside, Rotation.identity())


def _move(world: World, rng: np.random.Generator, shift_mm: np.ndarray, turn: Rotation) -> None:
    about = world.hip.head_mm
    motion = RigidTransform.from_components(about - turn.apply(about) + shift_mm, turn)
    world.moved = replace(world.hip, motions={"lateral": motion}).at("lateral")
    world.reclick(world.hip, rng, lateral=world.moved)


CLASSES: dict[str, Damage] = {
    "untouched": damage(nothing),
    "names of beads exchanged": damage(exchanged_ids),
    "beads displaced": damage(displaced_beads),
    "noise of beads understated": damage(understated_noise),
    "beads missing": damage(missing_beads),
    "torn": damage(torn, "torn", "rows", "shift"),
    "torn, lower beads dropped": damage(partial(torn, keep=False), "torn", "rows", "shift", "bead"),
    "sheared, stretched, turned": damage(warped),
    "clicks of the views exchanged": damage(views_exchanged),
    "row and column exchanged": damage(row_column),
    "points and views exchanged": damage(points_for_views),
    "one click 5-20 px off, across its curve": damage(one_pick_off),
    "one click 5-20 px along its curve": damage(one_pick_along),
    "clicks of 2-4 px stated as 0.5": damage(careless),
    "a landmark is another point": damage(landmark_off),
    "the head's circle is wrong": damage(head_off),
    "left-handed frame file": damage(mirrored_frame, "mirror", "hand"),
    "frame file of another scale": damage(scaled_frame),
    "plate shifted": damage(shifted_plate),
    "patient moved between the images": damage(moved_patient, "mov"),
    "patient moved in the plane of both beams": damage(moved_in_plane, "mov"),
}
CAMPAIGN = Campaign("points", "Beads, clicks, frames and patients that are not what they are said to be", CLASSES)
