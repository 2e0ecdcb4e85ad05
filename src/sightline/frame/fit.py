"""A frame adjusted to measurements: where its balls are, how well that is known, and what is wrong with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from sightline.checks import Check, failed
from sightline.errors import FrameError
from sightline.frame.adjust import FALSE_ALARM, Adjusted, adjust
from sightline.frame.deviations import Completed, PlateDeviation, complete, fiducials, plate_deviations, plates
from sightline.frame.identify import Identified, identify
from sightline.frame.measurements import Series
from sightline.frame.model import Frame
from sightline.frame.plate import FrameView, Plate
from sightline.frame.tolerances import EXPANSION_PER_K, Tolerances, error_factor

DRIFT_MM = 0.05  # physics.md, Frame [ours]: plate
DRIFT_RAD_PER_MM = 0.2e-3 / 0.05  # physics.md, Frame [ours]: plate
MIN_PER_PLATE = 4  # as in a frame file
MAX_DIAMETER_ERROR_MM = 0.3  # [ours] a ball of another size differs by more, a probe's fit by less
MAX_DEVIATION_SIGMA = float(np.sqrt(chdtri(3, FALSE_ALARM / 226)))  # once in 10,000 frames of the built-in kind
MIN_SERIES = 2  # series in which a ball that is far off must have been measured


@dataclass(frozen=True)
class Circumstances:
    """Which frame was measured, when, how warm; how warm it will be in use; and how far a plate may have moved by then
    (1 s.d. per axis; it turns with it as plates do, 0.2 mrad for 0.05 mm)."""

    serial: str | None = None
    measured_on: str | None = None
    temperature_c: float | None = None
    use_temperature_c: float | None = None
    drift_mm: float = DRIFT_MM

    def __post_init__(self) -> None:
        if self.use_temperature_c is not None and self.temperature_c is None:
            raise FrameError("a temperature of use says nothing without that of the measurement; give both")
        for value in (self.temperature_c, self.use_temperature_c):
            if value is not None and not -20 <= value <= 60:
                raise FrameError(f"{value:g} °C is no temperature that a frame of PMMA is measured or used at")
        if not 0 <= self.drift_mm <= 5:
            raise FrameError(f"a drift of {self.drift_mm:g} mm is no plate's; give 0 to 5 mm, 1 s.d.")

    @property
    def growth(self) -> float:
        """By what share a plate grows from measurement to use."""
        if self.temperature_c is None or self.use_temperature_c is None:
            return 0.0
        return EXPANSION_PER_K * (self.use_temperature_c - self.temperature_c)


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """What measurements say of a frame; `frame` is None where a check failed.

    After `identify` alone (wrong ids, wrong balls) `adjusted` and what follows it are empty. `deviation_mm` (N, 3):
    measured less nominal places of the balls `adjusted.ids`, CFCS, the whole frame laid on the nominal one; `sigma`
    (N,): how far each lies from where all others and the file's tolerances put it. `missing`: balls that were not
    measured, placed by the others.
    """

    frame: Frame | None
    checks: tuple[Check, ...]
    identified: tuple[Identified, ...]
    adjusted: Adjusted | None = None
    deviation_mm: np.ndarray | None = None
    sigma: np.ndarray | None = None
    plates: tuple[PlateDeviation, ...] = ()
    missing: tuple[str, ...] = ()


def fit_frame(frame: Frame, series: Sequence[Series], told: Circumstances) -> FittedFrame:
    """The frame that the series show. Raises FrameError where they do not determine one."""
    identified = tuple(identify(one, frame) for one in series)
    checks = (_ids(identified, frame), *_diameters(frame, series))
    if failed(checks):
        return FittedFrame(None, checks, identified)
    _refuse_thin_plates(frame, series)
    place = {f.id: (k, f.xyz_mm) for k, f in enumerate(fiducials(frame))}
    adjusted = adjust(series, [one.pose for one in identified], {ball: xyz for ball, (_, xyz) in place.items()})
    rows = np.array([place[ball][0] for ball in adjusted.ids])
    deviation = adjusted.xyz_mm - np.array([place[ball][1] for ball in adjusted.ids])
    whole = complete(frame, rows, deviation, adjusted.covariance_mm2)
    checks += (*_agreement(adjusted), _deviation(adjusted, series, whole.sigma))
    return FittedFrame(
        frame=None if failed(checks) else _measured(frame, whole, told),
        checks=checks,
        identified=identified,
        adjusted=adjusted,
        deviation_mm=deviation,
        sigma=whole.sigma,
        plates=plate_deviations(frame, rows, deviation, adjusted.covariance_mm2),
        missing=tuple(ball for ball in place if ball not in set(adjusted.ids)),
    )


def _measured(frame: Frame, whole: Completed, told: Circumstances) -> Frame:
    """The frame as it will be used: the balls moved, the plates grown, what may still happen to them added."""
    moves = iter(whole.moved_mm)

    def plate(one: Plate) -> Plate:
        xyz = one.xyz_mm + np.array([next(moves) for _ in one.ids])
        xyz += told.growth * (xyz - xyz.mean(axis=0))
        balls = zip(one.fiducials, xyz.round(6).tolist(), strict=True)
        return Plate(tuple(replace(ball, xyz_mm=tuple(at)) for ball, at in balls))

    drift = Tolerances(0.0, told.drift_mm, told.drift_mm * DRIFT_RAD_PER_MM, 0.0, 0.0)
    factor = error_factor(frame.views, drift)
    covariance = whole.covariance_mm2 + factor @ factor.T
    covariance.flags.writeable = False
    return replace(
        frame,
        views={name: FrameView(plate(view.xrii), plate(view.source)) for name, view in frame.views.items()},
        serial=told.serial or frame.serial,
        measured_on=told.measured_on,
        temperature_c=told.temperature_c if told.use_temperature_c is None else told.use_temperature_c,
        tolerances=None,
        covariance_mm2=covariance,
    )


def _ids(identified: Sequence[Identified], frame: Frame) -> Check:
    """Whether every ball lies at the place of its own id."""
    said = [sentence for one in identified if (sentence := _slip(one, frame))]
    wrong = sum(len(one.renamed) + len(one.astray_mm) for one in identified)
    figure = float(max(wrong, len(said)))
    sentence = " ".join(said) or "Every measured ball lies at the place of its own id."
    return Check("measured ids", not said, figure, 0.0, "balls", sentence)


def _slip(one: Identified, frame: Frame) -> str:
    """What is wrong with the ids of a series, or nothing."""
    out = f"Series {one.series}: "
    if one.mirrored:
        return out + (
            "it fits the frame only as a mirror image; one axis of the instrument is reversed, or its axes are "
            "left-handed: turn one axis round and write the table again."
        )
    whole = [
        f"the {view} {role} plate is numbered from another corner, or as another plate"
        for view, role, plate in plates(frame)
        if sum(ball in one.renamed for ball in plate.ids) > len(plate.ids) / 2
    ]
    if whole:
        return out + "; ".join(whole) + ". Write the table with the ids as the drawing has them."
    pairs = {frozenset(pair) for pair in one.renamed.items() if one.renamed.get(pair[1]) == pair[0]}
    exchanged = [" and ".join(sorted(pair)) for pair in pairs]
    others = [f"{a} fits the place of {b}" for a, b in one.renamed.items() if one.renamed.get(b) != a]
    astray = [f"{ball} lies {mm:.1f} mm from its place and fits no other" for ball, mm in one.astray_mm.items()]
    parts = [f"{_some(sorted(exchanged))} are exchanged"] if exchanged else []
    parts += [_some(items) for items in (others, astray) if items]
    return out + "; ".join(parts) + ". Correct the table, or measure these balls again." if parts else ""


def _some(items: Sequence[str], shown: int = 6) -> str:
    more = len(items) - shown
    return ", ".join(items[:shown]) + (f" and {more} more" if more > 0 else "")


def _diameters(frame: Frame, series: Sequence[Series]) -> list[Check]:
    """Whether the balls are as large as the frame has them; the one thing that tells a frame measured end for end."""
    nominal = {f.id: f.diameter_mm for f in fiducials(frame)}
    found = [
        (abs(diameter - nominal[ball]), ball, diameter)
        for one in series
        for ball, diameter in zip(one.ids, one.diameter_mm, strict=True)
        if np.isfinite(diameter)
    ]
    if not found:
        return []
    worst, ball, diameter = max(found)
    passed = bool(worst <= MAX_DIAMETER_ERROR_MM)
    wrong = [name for slip, name, _ in found if slip > MAX_DIAMETER_ERROR_MM]
    sentence = (
        "Every ball that was measured has its own diameter."
        if passed
        else f"{_some(wrong)}: not the balls of the frame file ({ball} is {diameter:.2f} mm, not "
        f"{nominal[ball]:g} mm). Wrong balls were set in, or the whole series is numbered from another corner."
    )
    return [Check("measured diameters", passed, float(worst), MAX_DIAMETER_ERROR_MM, "mm", sentence)]


def _refuse_thin_plates(frame: Frame, series: Sequence[Series]) -> None:
    measured = {ball for one in series for ball in one.ids}
    for view, role, plate in plates(frame):
        mine = np.array([ball in measured for ball in plate.ids])
        points = plate.xyz_mm[mine]
        broad = len(points) >= MIN_PER_PLATE and np.linalg.svd(points - points.mean(axis=0))[1][1] > 1.0
        if not broad:
            raise FrameError(
                f"{mine.sum()} balls of the {view} {role} plate were measured; {MIN_PER_PLATE} that are not on a "
                "line are needed of every plate, or nothing tells where it stands"
            )


def _agreement(adjusted: Adjusted) -> list[Check]:
    """Whether repeats differ by as much as is stated."""
    if adjusted.disputed:
        ball = adjusted.disputed[0]
        sentence = f"Two series see {ball} at different places and no third tells which is right: measure it once more."
        return [Check("measured series", False, None, None, "", sentence)]
    if adjusted.chi_square is None:
        return []
    figure = adjusted.chi_square / adjusted.freedom
    limit = float(chdtri(adjusted.freedom, FALSE_ALARM)) / adjusted.freedom
    sentence = (
        "The series differ as their stated errors let expect; the repeats show "
        f"{adjusted.instrument_mm:.4f} mm per axis."
        if figure <= limit
        else f"The series differ by {np.sqrt(figure):.1f} times what is stated: the instrument errs by "
        f"{adjusted.instrument_mm:.4f} mm per axis, or the frame changed between them. State the larger error, or "
        "measure again."
    )
    out = [Check("measured series", figure <= limit, figure, limit, "", sentence)]
    if adjusted.left_out:
        names = _some([f"{ball} in series {series}" for series, ball in adjusted.left_out])
        sentence = f"Measurements that contradict those of the other series were left out: {names}."
        out.append(Check("measurements left out", True, float(len(adjusted.left_out)), None, "", sentence))
    return out


def _deviation(adjusted: Adjusted, series: Sequence[Series], sigma: np.ndarray) -> Check:
    """Whether a ball lies where no tolerance puts it, and nobody measured it twice."""
    left_out = set(adjusted.left_out)
    seen = {b: sum(b in one.ids and (one.name, b) not in left_out for one in series) for b in adjusted.ids}
    far = [k for k in np.argsort(-sigma) if sigma[k] > MAX_DEVIATION_SIGMA]
    doubtful = [k for k in far if seen[adjusted.ids[k]] < MIN_SERIES]
    worst = doubtful[0] if doubtful else int(np.argmax(sigma))
    names = _some([f"{adjusted.ids[k]} ({sigma[k]:.1f})" for k in (doubtful or far)])
    if doubtful:
        sentence = (
            f"Balls lie where neither tolerance nor instrument puts them (s.d. in brackets): {names}. A wrong number, "
            "or a ball that sits wrong: measure them again as a second series; where both agree they are taken."
        )
    elif far:
        sentence = (
            f"Balls beyond their tolerance, confirmed by a second series: {names}. Their measured places are used."
        )
    else:
        sentence = "Every ball lies within the tolerances of the frame file."
    return Check("measured deviation", not doubtful, float(sigma[worst]), MAX_DEVIATION_SIGMA, "s.d.", sentence)
