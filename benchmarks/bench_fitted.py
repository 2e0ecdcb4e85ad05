"""Head, shaft and neck of rendered hips, fitted to the edges of the images: errors over the stated ones.

Each hip is drawn from its own seed, none of which was used for tuning. A person's clicks on the true outlines have
errors of 2 px. Views are calibrated from the images. Drawings that are kept are counted.

The true axis of a neck is the twin's own, through the head's centre and the point where it meets the shaft's axis. In a
lateral image the neck is seen along its beam. So hips are rendered again with a lateral beam across the neck.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

import sightline as sl
from benchmarks.drawn_necks import neck_clicks
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row, finished
from sightline.calibration.view import CalibratedView
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.from_images.head_and_shaft import fit_head, fit_shaft
from sightline.from_images.neck import fit_neck
from sightline.planning.bone.aids import Aids, Circle, Line
from sightline.planning.bone.anatomy import locate
from sightline.planning.bone.drawings import Axis
from sightline.planning.bone.head import Sphere
from sightline.twin import HipScene, SetUp, render
from sightline.twin.anatomy.bone_model import SphereAid, drawn_aids
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.scenes.hip_scene import shown_hip_scene
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.setup import BEAMS, ViewTruth

HIPS, WITH_PLATES, ACROSS = 100, 30, 60  # with a block; with the Γ frame; with a block and a beam across the neck
FIRST_ACROSS = 2000  # the error stated in lateral images was raised after a run of the first hips
CLICK_PX = 2.0
MOST_RATIO = 1.15  # error over stated s.d.: of 60 fits with 2 numbers each an honest one is 1 +- 0.065 [calc]
GROUP = "fitted to edges"
# Begin of drawn borders, mm caudal of where neck and shaft meet: below the lesser trochanter, and beside it [ours].
BELOW_MM, BESIDE_MM, LENGTH_MM = (48.0, 56.0), (36.0, 44.0), (20.0, 40.0)
# Lateral beam across the neck: lateral, caudal of a right hip, anterior [ours].
ACROSS_NECK = np.array([0.64, -0.77, 0.0])
NECK_AXIS = (0.25, 0.75)  # of the way from the head's centre, where the studies click on a neck's axis
VISIBLE_MM = (5.0, 12.0)  # between plates the field ends at about 40 mm


@dataclass(frozen=True)
class _Number:
    """What is fitted: its name, how many components it has, and their unit."""

    name: str
    size: int
    unit: str


HEAD = _Number("centre", 3, "mm"), _Number("radius", 1, "mm")
SHAFT = _Number("offset", 2, "mm"), _Number("direction", 2, "°")
NECK = _Number("offset", 1, "mm"), _Number("direction", 1, "°")  # in the image


@dataclass(frozen=True)
class _Fit:
    """Of both numbers of HEAD, SHAFT or NECK: squared errors over their stated covariance, and lengths of the error, of
    that of the drawing, and of the stated one; NaN unless `images`, those that were fitted, are all. `axis`: length of
    the error of clicks on the true axis of a neck."""

    images: int
    squares: tuple[float, float] = (np.nan, np.nan)
    error: tuple[float, float] = (np.nan, np.nan)
    drawn: tuple[float, float] = (np.nan, np.nan)
    stated: tuple[float, float] = (np.nan, np.nan)
    axis: tuple[float, float] = (np.nan, np.nan)


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark; `quick` takes a tenth of the hips."""
    many, few, across = (n // 10 if quick else n for n in (HIPS, WITH_PLATES, ACROSS))
    block, refused = finished(GROUP, in_parallel(_with_block, range(many), keep="fitted-block"))
    plates, also = finished(GROUP, in_parallel(_with_plates, range(few), keep="fitted-plates"))
    beside, too = finished(
        GROUP, in_parallel(_across_neck, range(FIRST_ACROSS, FIRST_ACROSS + across), keep="fitted-necks")
    )
    return [
        *refused,
        *_rows("head", [hip[0] for hip in block], HEAD, MOST_RATIO),
        *_rows("shaft below the lesser trochanter", [hip[1] for hip in block], SHAFT, MOST_RATIO),
        *_rows("shaft beside the lesser trochanter", [hip[2] for hip in block], SHAFT),
        *_rows("neck, PA image", [hip[3] for hip in block], NECK, MOST_RATIO, 1),
        *_rows("neck, lateral image", [hip[4] for hip in block], NECK, MOST_RATIO, 1),
        *also,
        *_rows("head between plates", [hip[0] for hip in plates], HEAD),
        *_rows("shaft between plates", [hip[1] for hip in plates], SHAFT),
        *_rows("neck between plates, PA image", [hip[2] for hip in plates], NECK, None, 1),
        *too,
        *_rows("neck, lateral image across it", [hip[1] for hip in beside], NECK, MOST_RATIO, 1),
    ]


def _rows(
    what: str, fits: list[_Fit], numbers: tuple[_Number, _Number], most: float | None = None, images: int = 2
) -> list[Row]:
    """Return the rows of one kind of fit; `most`: the largest ratio of error and stated s.d. asked for; `images`: those
    that each is fitted in."""
    counts = " / ".join(str(sum(fit.images == n for fit in fits)) for n in range(images, -1, -1))
    label = "fitted in both images / one / none" if images == 2 else "fitted / kept"
    rows = [Row(GROUP, f"{what}: {label}", f"{counts} of {len(fits)}")]
    done = [fit for fit in fits if fit.images == images]
    for k, one in enumerate(numbers if done else ()):
        squares, error, stated, drawn, axis = (
            np.array([getattr(fit, name)[k] for fit in done])
            for name in ("squares", "error", "stated", "drawn", "axis")
        )
        ratio, inside = float(np.sqrt(squares.mean() / one.size)), float(np.mean(squares <= chi2.ppf(0.95, one.size)))
        rms = [f"{np.sqrt(np.mean(values**2)):.2f} {one.unit}" for values in (error, stated, drawn, axis)]
        rows.append(
            Row(
                GROUP,
                f"{what}, {one.name}: error / stated s.d.; within 95 %; rms error, stated",
                f"{ratio:.2f}; {100 * inside:.0f} %; {rms[0]}, {rms[1]}",
                "" if most is None else f"<= {most:g}",
                f"as drawn {rms[2]}" + ("" if np.isnan(axis).all() else f"; clicks on the true axis {rms[3]}"),
                None if most is None else ratio <= most,
            )
        )
    return rows


def _with_block(seed: int) -> tuple[_Fit, ...] | str:
    """Return the fits of a head, of a shaft below the lesser trochanter, of one beside it, and of a neck by image."""
    try:
        hip = _Hip.drawn(seed, "block60")
    except SightlineError as refused:
        return f"seed {seed}: {refused}"
    return hip.head(), hip.shaft(BELOW_MM), hip.shaft(BESIDE_MM), *hip.neck()


def _across_neck(seed: int) -> tuple[_Fit, ...] | str:
    """Return the fits of a neck in a PA image, and in a lateral one whose beam crosses it."""
    try:
        return _Hip.drawn(seed, "block60", across_neck=True).neck()
    except SightlineError as refused:
        return f"seed {seed}: {refused}"


def _with_plates(seed: int) -> tuple[_Fit, ...] | str:
    """Return the fits of a head, of the visible part of a shaft, and of a neck in the PA image."""
    try:
        hip = _Hip.drawn(seed, "gamma")
    except SightlineError as refused:
        return f"seed {seed}: {refused}"
    return hip.head(), hip.shaft(VISIBLE_MM), hip.neck()[0]


@dataclass(frozen=True, eq=False)
class _Hip:
    """A rendered hip, its images and calibrated views, PA first."""

    rng: np.random.Generator
    setup: SetUp
    scene: HipScene
    images: Sequence[sl.Radiograph]
    views: Sequence[CalibratedView]

    @staticmethod
    def drawn(seed: int, frame: str, *, across_neck: bool = False) -> "_Hip":
        """Raises SightlineError where its images cannot be calibrated."""
        warnings.simplefilter("ignore", RuntimeWarning)  # of bead truths outside the field
        rng = np.random.default_rng([97, seed])
        known = Frame.load(frame)
        side, beams = str(rng.choice(["right", "left"])), {}
        if across_neck:
            beams["views"] = {"pa": BEAMS["pa"], "lateral": to_cfcs(ACROSS_NECK, side, np.zeros(3))}
        setup, scene = shown_hip_scene(rng, known, side, **beams)
        images = [tagged(setup, name, render(setup, name, scene.scene, rng)) for name in setup.views]
        views = [sl.calibrate_image(image, known, name) for name, image in zip(setup.views, images, strict=True)]
        return _Hip(rng, setup, scene, images, views)

    @cached_property
    def circles(self) -> tuple[tuple[Circle, Circle], tuple[Circle, Circle], dict[str, str]]:
        """Three clicks on the head's rim in each image, their fit, and what was kept."""
        outline = SphereAid(self.scene.head_mm, self._radius_mm)
        pixels = drawn_aids({"head": outline}, self.setup.views)["head"]
        first, second = (Circle.through(self._clicked(pixels[name]), CLICK_PX) for name in self.setup.views)
        return (first, second), *fit_head(self.views, self.images, (first, second))

    def head(self) -> _Fit:
        """Return the fit of three clicks on the rim in each image."""
        drawn, fitted, kept = self.circles
        before, after = (locate(self.views, Aids(head=each)).head for each in (drawn, fitted))
        if kept or before is None or after is None or after.covariance_mm2 is None:
            return _Fit(2 - len(kept))
        off = self._off(after)
        covariance = after.covariance_mm2
        squares = float(off[:3] @ np.linalg.solve(covariance[:3, :3], off[:3])), float(off[3] ** 2 / covariance[3, 3])
        stated = float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(covariance[3, 3]))
        return _Fit(2, squares, _lengths(off), _lengths(self._off(before)), stated)

    @property
    def _radius_mm(self) -> float:
        """Radius of the head's surface away from the neck: the neck's end lies in the head and makes it larger."""
        femur = self.scene.femur
        return float(np.linalg.norm(femur.surface_mm(np.zeros(3), femur.towards_head)))

    def _off(self, head: Sphere) -> np.ndarray:
        return np.append(head.centre_mm - self.scene.head_mm, head.radius_mm - self._radius_mm)

    def shaft(self, begin_mm: tuple[float, float]) -> _Fit:
        """Return the fit of both borders in each image, begun so far caudal of where the axes meet."""
        first, second = (Line.between(self._borders(name, begin_mm), CLICK_PX) for name in self.setup.views)
        try:
            fitted, kept = fit_shaft(self.views, self.images, (first, second))
        except SightlineError:
            return _Fit(0)
        before, after = (locate(self.views, Aids(shaft=each)).shaft for each in ((first, second), fitted))
        if kept or before is None or after is None:
            return _Fit(2 - len(kept))
        made, drawn = self._axis(after), self._axis(before)
        return _Fit(2, (made[0], made[1]), (made[2], made[3]), (drawn[2], drawn[3]), (made[4], made[5]))

    def neck(self) -> tuple[_Fit, _Fit]:
        """Return the fit of both borders of the neck in each image, from the head past the narrowest place."""
        drawn, axes = [], []
        for view in self.setup.views.values():
            clicks = self._in_cfcs(neck_clicks(self.scene.femur, self._source(view), self.rng).reshape(4, 3))
            drawn.append(Line.between(self._clicked(view.project(clicks)).reshape(2, 2, 2), CLICK_PX))
            on_axis = self._in_cfcs(np.outer(NECK_AXIS, self.scene.femur.base_mm))
            axes.append(Line(self._clicked(view.project(on_axis)), CLICK_PX))
        lines, kept = fit_neck(self.views, self.images, (drawn[0], drawn[1]), self.circles[1])
        fits = [
            _Fit(0) if view.name in kept else self._neck(view, *three)
            for view, *three in zip(self.views, lines, drawn, axes, strict=True)
        ]
        return fits[0], fits[1]

    def _neck(self, view: CalibratedView, fitted: Line, drawn: Line, axis: Line) -> _Fit:
        """Return the errors of lines along the neck in one image."""
        (offset, turned), (offset_sd, turned_sd) = self._in_image(view, fitted)
        squares = (offset / offset_sd) ** 2, (turned / turned_sd) ** 2
        others = [self._in_image(view, line)[0] for line in (drawn, axis)]
        return _Fit(1, squares, (offset, turned), others[0], (offset_sd, turned_sd), others[1])

    def _in_image(self, view: CalibratedView, line: Line) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return offset and rotation of a line against the neck's true axis on the view's plane, at the middle of the
        line, mm in the bone and °; and their stated s.d."""
        ends = self._in_cfcs(np.outer([0.0, 1.0], self.scene.femur.base_mm))
        seen, true = view.lines_of_sight(line.uv_px), view.lines_of_sight(view.project(ends))
        middle = true.plane.to_space(true.xy_mm).mean(axis=0)
        scale = float(np.linalg.norm(ends.mean(axis=0) - true.focal_point_mm))
        scale /= float(np.linalg.norm(middle - true.focal_point_mm))
        along = true.xy_mm[1] - true.xy_mm[0]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        way = seen.xy_mm[1] - seen.xy_mm[0]
        length = float(np.linalg.norm(way))
        offset = scale * across @ (seen.xy_mm.mean(axis=0) - true.xy_mm[0])
        turned = np.arcsin(across @ way / length)
        spread = np.zeros((4, 4))
        spread[:2, :2], spread[2:, 2:] = seen.jacobian
        spread = spread @ line.spread_px2 @ spread.T
        by_ends = scale * np.concatenate([across, across]) / 2, np.concatenate([-across, across]) / length
        sds = [float(np.sqrt(one @ spread @ one)) for one in by_ends]
        return (float(offset), float(np.rad2deg(turned))), (sds[0], float(np.rad2deg(sds[1])))

    def _in_cfcs(self, points_mm: np.ndarray) -> np.ndarray:
        return to_cfcs(points_mm, self.setup.side, self.scene.head_mm)

    def _source(self, view: ViewTruth) -> np.ndarray:
        """Return the X-ray source (3,), anatomical."""
        return to_cfcs(view.focal_point_mm - self.scene.head_mm, self.setup.side, np.zeros(3))

    def _borders(self, name: str, begin_mm: tuple[float, float]) -> np.ndarray:
        """Return clicks (2, 2, 2) on both borders in an image."""
        view, femur = self.setup.views[name], self.scene.femur
        source = self._source(view)
        first = self.rng.uniform(*begin_mm)
        down = first + np.array([0.0, self.rng.uniform(*LENGTH_MM)])
        out = []
        for way in (1.0, -1.0):
            for mm in down + self.rng.uniform(-3.0, 3.0, 2):
                on = femur.base_mm + np.array([0.0, mm, 0.0])
                sideways = way * np.cross(on - source, [0.0, 1.0, 0.0])
                out.append(femur.surface_mm(on, sideways / np.linalg.norm(sideways)))
        return self._clicked(view.project(self._in_cfcs(np.array(out)))).reshape(2, 2, 2)

    def _clicked(self, uv_px: np.ndarray) -> np.ndarray:
        return uv_px + CLICK_PX * self.rng.standard_normal(uv_px.shape)

    def _axis(self, axis: Axis) -> tuple[float, float, float, float, float, float]:
        """Return squares of offset and direction, their errors, and the stated ones; mm and °."""
        base, knee = self._in_cfcs(self.scene.femur.base_mm + np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
        true, middle = knee - base, axis.ends_mm.mean(axis=0)
        across = np.linalg.svd(axis.direction[None])[2][1:]
        length = np.linalg.norm(axis.ends_mm[1] - axis.ends_mm[0])
        wrong = (
            across @ (base + (middle - base) @ true * true - middle),
            across @ true * np.sign(true @ axis.direction),
        )
        by_ends = across @ np.hstack([np.eye(3), np.eye(3)]) / 2, across @ np.hstack([-np.eye(3), np.eye(3)]) / length
        assert axis.covariance_mm2 is not None
        stated = [one @ axis.covariance_mm2 @ one.T for one in by_ends]
        squares = [float(off @ np.linalg.solve(own, off)) for off, own in zip(wrong, stated, strict=True)]
        sds = [float(np.sqrt(np.trace(own))) for own in stated]
        (offset, turned) = (float(np.linalg.norm(off)) for off in wrong)
        return squares[0], squares[1], offset, float(np.rad2deg(turned)), sds[0], float(np.rad2deg(sds[1]))


def _lengths(off: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm(off[:3])), float(abs(off[3]))
