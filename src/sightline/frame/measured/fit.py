"""A frame fitted to measurements: positions of its balls, their covariance, deviations by ball and body, and checks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betaincinv, chdtri

from sightline.common.checks import FALSE_ALARM, Check, failed
from sightline.common.geometry.rigid import displacement
from sightline.errors import FrameError
from sightline.frame.designs import SOLIDS
from sightline.frame.measured.adjust import Adjusted, adjust
from sightline.frame.measured.identify import Identified, identify
from sightline.frame.model import Frame
from sightline.frame.plate import Plate, RigidBody
from sightline.frame.tables import Series
from sightline.frame.tolerances import EXPANSION_PER_K, Tolerances

DRIFT_RAD_PER_MM = Tolerances.plate_rad / Tolerances.plate_mm  # a plate drifts by its tolerance
MIN_PER_PLATE = 4  # as in a frame file
MAX_DIAMETER_ERROR_MM = 0.3  # [ours] a ball of another size differs by more, a probe's measurement by less
MAX_DEVIATION_SIGMA = float(np.sqrt(chdtri(3, FALSE_ALARM / 226)))  # once in 10,000 frames of the built-in kind
MIN_SERIES = 2  # series that must confirm a ball's deviation beyond its tolerance
MAX_BEAD_MM = 2.0  # [ours] largest scatter of a frame's balls that is estimated; a hand-held drill does better
# [ours] prior s.d., mm, of a rigid motion of the whole frame, which is not an error of a plate.
WHOLE_FRAME_MM = 10.0


@dataclass(frozen=True, eq=False)
class Completed:
    """All M balls of a frame: `moved_mm` (M, 3), displacements from nominal; `covariance_mm2` (3M, 3M) of these.

    `sigma` (N,): distance of each measured ball from its prediction by all others and the tolerances, in standard
    deviations.
    """

    moved_mm: np.ndarray
    covariance_mm2: np.ndarray
    sigma: np.ndarray


def complete(frame: Frame, rows: np.ndarray, moved_mm: np.ndarray, covariance_mm2: np.ndarray) -> Completed:
    """Return all balls, from `moved_mm` (N, 3) of the measured balls `rows` (N,) and its covariance (3N, 3N).

    Measured balls keep their measured places. The others are predicted from these and the frame's tolerances.
    """
    all_xyz = frame.xyz_mm
    centred = all_xyz - all_xyz.mean(axis=0)
    whole = displacement(centred).reshape(-1, 6) * WHOLE_FRAME_MM
    whole[:, :3] /= np.linalg.norm(centred, axis=1).mean()
    tolerance = np.hstack([frame.error_factor, whole])
    seen = (3 * rows[:, None] + np.arange(3)).ravel()
    unseen = np.setdiff1d(np.arange(len(tolerance)), seen)
    own, others = tolerance[seen], tolerance[unseen]
    precision = np.linalg.inv(own @ own.T + covariance_mm2)
    pull = (precision @ moved_mm.ravel()).reshape(-1, 3)
    n = len(rows)
    blocks = precision.reshape(n, 3, n, 3)[range(n), :, range(n), :]
    sigma = np.sqrt(np.einsum("na,na->n", pull, np.linalg.solve(blocks, pull[..., None])[..., 0]))
    gain = others @ own.T @ precision
    moved, error = np.zeros(len(tolerance)), np.zeros((len(tolerance), len(tolerance)))
    moved[seen], moved[unseen] = moved_mm.ravel(), gain @ moved_mm.ravel()
    error[np.ix_(seen, seen)] = covariance_mm2
    error[np.ix_(unseen, seen)] = gain @ covariance_mm2
    error[np.ix_(seen, unseen)] = error[np.ix_(unseen, seen)].T
    error[np.ix_(unseen, unseen)] = others @ others.T - gain @ own @ others.T
    return Completed(moved.reshape(-1, 3), (error + error.T) / 2, sigma)


@dataclass(frozen=True, eq=False)
class PlateDeviation:
    """Deviations of one plate from the frame file: motion as a whole (CFCS), expansion about its mean, balls within it.

    `in_plane_rms_mm`, `across_rms_mm`: deviations of the balls per axis from the moved and expanded plate, including
    the instrument's error, `instrument_mm` per axis. Of a solid `in_plane_rms_mm` has all three axes, and
    `across_rms_mm` is None.
    """

    view: str
    plate: str
    measured: int
    shift_mm: np.ndarray
    turn_rad: np.ndarray
    growth_ppm: float
    in_plane_rms_mm: float
    across_rms_mm: float | None
    instrument_mm: float

    @property
    def manufacturing_mm(self) -> float:
        """S.d. per axis of the bores in the plate, the instrument's noise subtracted."""
        return float(np.sqrt(max(0.0, self.in_plane_rms_mm**2 - self.instrument_mm**2)))


def plate_deviations(
    frame: Frame, rows: np.ndarray, moved_mm: np.ndarray, covariance_mm2: np.ndarray
) -> tuple[PlateDeviation, ...]:
    """Return the deviations of each plate, or of the solid; arguments as for `complete`."""
    variances = np.diag(covariance_mm2).reshape(-1, 3)
    deviations, start = [], 0
    for view, role, body in bodies(frame):
        own = (rows >= start) & (rows < start + len(body.ids))
        deviations.append(_body_deviation(view, role, body, rows[own] - start, moved_mm[own], variances[own]))
        start += len(body.ids)
    return tuple(deviations)


def _body_deviation(  # noqa: PLR0917
    view: str, role: str, body: RigidBody, rows: np.ndarray, moved: np.ndarray, variances: np.ndarray
) -> PlateDeviation:
    flat = isinstance(body, Plate)
    xyz = body.xyz_mm[rows]
    centred = xyz - body.xyz_mm.mean(axis=0)
    design = np.hstack([displacement(centred).reshape(-1, 6), centred.reshape(-1, 1)])
    parameters = np.linalg.lstsq(design, moved.ravel(), rcond=None)[0]
    residual = moved - (design @ parameters).reshape(-1, 3)
    free = 1 - len(parameters) / moved.size
    return PlateDeviation(
        view=view,
        plate=role,
        measured=len(rows),
        shift_mm=parameters[3:6],
        turn_rad=parameters[:3],
        growth_ppm=float(1e6 * parameters[6]),
        in_plane_rms_mm=float(np.sqrt(np.mean((residual @ body.plane.axes.T if flat else residual) ** 2) / free)),
        across_rms_mm=float(np.sqrt(np.mean((residual @ body.plane.normal) ** 2) / free)) if flat else None,
        instrument_mm=float(np.sqrt(variances.mean())),
    )


def bodies(frame: Frame) -> tuple[tuple[str, str, RigidBody], ...]:
    """Return (view, role, plate) of each plate, or ("solid", "", solid) and that on the detector, in the order of the
    frame's covariance."""
    if frame.solid is None:
        return frame.named_plates
    return tuple(zip(("solid", "detector"), ("", "plate"), frame.bodies, strict=False))


@dataclass(frozen=True)
class Circumstances:
    """Circumstances of a measurement: frame, date, temperature, temperature of use, and drift of a plate until use.

    `drift_mm`: 1 s.d. per axis; a plate rotates with it by 0.2 mrad for 0.05 mm. Raises FrameError.
    """

    serial: str | None = None
    measured_on: str | None = None
    temperature_c: float | None = None
    use_temperature_c: float | None = None
    drift_mm: float = Tolerances.plate_mm

    def __post_init__(self) -> None:
        if self.use_temperature_c is not None and self.temperature_c is None:
            raise FrameError("give the temperature of the measurement together with the temperature of use")
        for value in (self.temperature_c, self.use_temperature_c):
            if value is not None and not -20 <= value <= 60:
                raise FrameError(f"give a temperature from -20 to 60 °C for a frame of PMMA, not {value:g} °C")
        if not 0 <= self.drift_mm <= 5:
            raise FrameError(f"give a plate's drift of 0 to 5 mm, 1 s.d., not {self.drift_mm:g} mm")

    @property
    def growth(self) -> float:
        """Relative thermal expansion of a plate or solid from measurement to use."""
        if self.temperature_c is None or self.use_temperature_c is None:
            return 0.0
        return EXPANSION_PER_K * (self.use_temperature_c - self.temperature_c)


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """A frame fitted to measurements; `frame` is None where a check failed.

    Where the ids or diameters are wrong, `adjusted` and the fields after it are empty. `deviation_mm` (N, 3): measured
    minus nominal places of the balls `adjusted.ids`, CFCS, with the whole frame aligned to the nominal one; `sigma`
    (N,): distance of each from its prediction by all others and the tolerances, in standard deviations. The tolerances
    are the file's, or where most balls contradict them, those that these balls show.
    `missing`: balls that were not measured and are predicted from the others.
    """

    frame: Frame | None
    checks: tuple[Check, ...]
    identified: tuple[Identified, ...]
    adjusted: Adjusted | None = None
    deviation_mm: np.ndarray | None = None
    sigma: np.ndarray | None = None
    plates: tuple[PlateDeviation, ...] = ()
    missing: tuple[str, ...] = ()


def fit_frame(frame: Frame, series: Sequence[Series], circumstances: Circumstances) -> FittedFrame:
    """Return the frame fitted to measured series. Raises FrameError where they do not determine one."""
    frame.refuse_plate("fit the solid and the plate each by a file of its own")
    identified = tuple(identify(each, frame) for each in series)
    checks = (_ids(identified, frame), *_diameters(frame, series))
    if failed(checks):
        return FittedFrame(None, checks, identified)
    _refuse_thin_bodies(frame, series)
    place = {f.id: (k, f.xyz_mm) for k, f in enumerate(frame.fiducials)}
    adjusted = adjust(series, [each.pose for each in identified], {ball: xyz for ball, (_, xyz) in place.items()})
    rows = np.array([place[ball][0] for ball in adjusted.ids])
    deviation = adjusted.xyz_mm - np.array([place[ball][1] for ball in adjusted.ids])
    whole = complete(frame, rows, deviation, adjusted.covariance_mm2)
    counts = _series_by_ball(adjusted, series)
    scatter, bead_mm = _scatter(frame, whole.sigma, (rows, deviation, adjusted.covariance_mm2), counts)
    if bead_mm is not None:
        whole = complete(_with_bead(frame, bead_mm), rows, deviation, adjusted.covariance_mm2)
    checks += (*_agreement(adjusted), scatter, _deviation(adjusted, counts, whole.sigma))
    return FittedFrame(
        frame=None if failed(checks) else _measured(frame, whole, circumstances),
        checks=checks,
        identified=identified,
        adjusted=adjusted,
        deviation_mm=deviation,
        sigma=whole.sigma,
        plates=plate_deviations(frame, rows, deviation, adjusted.covariance_mm2),
        missing=tuple(ball for ball in place if ball not in set(adjusted.ids)),
    )


def _measured(frame: Frame, whole: Completed, circumstances: Circumstances) -> Frame:
    """Return the frame as it will be used: balls at their measured places, thermal expansion and drift included."""
    places = frame.with_beads_at(frame.xyz_mm + whole.moved_mm)
    grown = [body.xyz_mm + circumstances.growth * (body.xyz_mm - body.xyz_mm.mean(axis=0)) for body in places.bodies]
    drift = Tolerances(0.0, circumstances.drift_mm, circumstances.drift_mm * DRIFT_RAD_PER_MM, 0.0, 0.0)
    factor = replace(frame, tolerances=drift, covariance_mm2=None, in_use=None).error_factor  # zero for a solid
    covariance = whole.covariance_mm2 + factor @ factor.T
    covariance.flags.writeable = False
    return replace(
        frame.with_beads_at(np.concatenate(grown).round(6)),
        serial=circumstances.serial or frame.serial,
        measured_on=circumstances.measured_on,
        temperature_c=circumstances.temperature_c
        if circumstances.use_temperature_c is None
        else circumstances.use_temperature_c,
        tolerances=None,
        covariance_mm2=covariance,
    )


def _ids(identified: Sequence[Identified], frame: Frame) -> Check:
    """Return the check that every ball lies at the place of its own id."""
    errors = [sentence for each in identified if (sentence := _id_errors(each, frame))]
    wrong = sum(len(each.renamed) + len(each.astray_mm) for each in identified)
    count = float(max(wrong, len(errors)))
    sentence = " ".join(errors) or "Every measured ball lies at the place of its own id."
    return Check("measured ids", not errors, count, 0.0, "balls", sentence)


def _id_errors(identified: Identified, frame: Frame) -> str:
    """Return a sentence on the wrong ids of a series; empty where all are right."""
    start = f"Series {identified.series}: "
    if identified.mirrored:
        return start + (
            "it fits the frame only as a mirror image: one axis of the instrument is reversed, or its axes are "
            "left-handed. Reverse one axis and write the table again."
        )
    whole = [
        f"the {view} {role} plate is numbered from another corner, or as another plate"
        for view, role, plate in frame.named_plates
        if sum(ball in identified.renamed for ball in plate.ids) > len(plate.ids) / 2
    ]
    if whole:
        return start + "; ".join(whole) + ". Write the table with the ids of the drawing."
    pairs = {frozenset(pair) for pair in identified.renamed.items() if identified.renamed.get(pair[1]) == pair[0]}
    exchanged = [" and ".join(sorted(pair)) for pair in pairs]
    others = [f"{a} fits the place of {b}" for a, b in identified.renamed.items() if identified.renamed.get(b) != a]
    astray = [f"{ball} lies {mm:.1f} mm from its place and fits no other" for ball, mm in identified.astray_mm.items()]
    parts = [f"{_some(sorted(exchanged))} are exchanged"] if exchanged else []
    parts += [_some(items) for items in (others, astray) if items]
    return start + "; ".join(parts) + ". Correct the table, or measure these balls again." if parts else ""


def _some(items: Sequence[str], shown: int = 6) -> str:
    more = len(items) - shown
    return ", ".join(items[:shown]) + (f" and {more} more" if more > 0 else "")


def _diameters(frame: Frame, series: Sequence[Series]) -> list[Check]:
    """Return the check of the balls' diameters, which alone shows a frame that was measured the wrong way round."""
    nominal = {f.id: f.diameter_mm for f in frame.fiducials}
    errors = [
        (abs(diameter - nominal[ball]), ball, diameter)
        for each in series
        for ball, diameter in zip(each.ids, each.diameter_mm, strict=True)
        if np.isfinite(diameter)
    ]
    if not errors:
        return []
    worst, ball, diameter = max(errors)
    passed = bool(worst <= MAX_DIAMETER_ERROR_MM)
    wrong = [name for error, name, _ in errors if error > MAX_DIAMETER_ERROR_MM]
    sentence = (
        "Every measured ball has the diameter of the frame file."
        if passed
        else f"{_some(wrong)}: not the balls of the frame file ({ball} is {diameter:.2f} mm, not "
        f"{nominal[ball]:g} mm). Wrong balls were mounted, or the whole series is numbered from another corner."
    )
    return [Check("measured diameters", passed, float(worst), MAX_DIAMETER_ERROR_MM, "mm", sentence)]


def _refuse_thin_bodies(frame: Frame, series: Sequence[Series]) -> None:
    measured = {ball for each in series for ball in each.ids}
    for view, role, body in bodies(frame):
        is_measured = np.array([ball in measured for ball in body.ids])
        points = body.xyz_mm[is_measured]
        what, rank, shape = ("plate", 2, "on one line") if isinstance(body, Plate) else ("", 3, "in one plane")
        broad = len(points) >= MIN_PER_PLATE and np.linalg.svd(points - points.mean(axis=0))[1][rank - 1] > 1.0
        if not broad:
            raise FrameError(
                f"{is_measured.sum()} balls of the {' '.join(filter(None, (view, role, what)))} were measured; measure "
                f"at least {MIN_PER_PLATE} of {'every plate' if what else 'them'} that do not lie {shape}, to "
                "determine its place"
            )


def _agreement(adjusted: Adjusted) -> list[Check]:
    """Return the check that repeated measurements agree with their stated errors."""
    if adjusted.disputed:
        ball = adjusted.disputed[0]
        sentence = f"Measure {ball} once more: two series have it at different places, with no third to decide."
        return [Check("measured series", False, None, None, "", sentence)]
    if adjusted.chi_square is None:
        return []
    reduced = adjusted.chi_square / adjusted.freedom
    limit = float(chdtri(adjusted.freedom, FALSE_ALARM)) / adjusted.freedom
    sentence = (
        "The differences between the series agree with their stated errors; the repeats show "
        f"{adjusted.instrument_mm:.4f} mm per axis."
        if reduced <= limit
        else f"The series differ by {np.sqrt(reduced):.1f} times what is stated: the instrument's error is "
        f"{adjusted.instrument_mm:.4f} mm per axis, or the frame changed between them. State the larger error, or "
        "measure again."
    )
    checks = [Check("measured series", reduced <= limit, reduced, limit, "", sentence)]
    if adjusted.left_out:
        names = _some([f"{ball} in series {series}" for series, ball in adjusted.left_out])
        sentence = f"Measurements that contradict those of the other series were left out: {names}."
        checks.append(Check("measurements left out", True, float(len(adjusted.left_out)), None, "", sentence))
    return checks


def _series_by_ball(adjusted: Adjusted, series: Sequence[Series]) -> list[int]:
    """Return how many series measured each ball, without those left out."""
    left_out = set(adjusted.left_out)
    return [sum(b in each.ids and (each.name, b) not in left_out for each in series) for b in adjusted.ids]


def _with_bead(frame: Frame, bead_mm: float) -> Frame:
    return replace(frame, tolerances=replace(frame.effective_tolerances, bead_mm=bead_mm))


def _scatter(
    frame: Frame, sigma: np.ndarray, measured: tuple[np.ndarray, np.ndarray, np.ndarray], counts: Sequence[int]
) -> tuple[Check, float | None]:
    """Return the check that most balls lie within the tolerances, and the bead tolerance that most balls show.

    The median is judged, which a wrong number does not move. `measured`: arguments of `complete` after the frame;
    `counts`: series by ball. The tolerance is None where the file's holds, or states a covariance instead.
    """
    half = (len(sigma) + 1) / 2
    usual = chdtri(3, 0.5)
    # The median of N values is a beta variate of their distribution.
    limit = float(np.sqrt(chdtri(3, betaincinv(half, half, FALSE_ALARM)) / usual))
    ratio = float(np.median(sigma) / np.sqrt(usual))
    name, most = "measured tolerance", None
    if ratio <= limit:
        return Check(name, True, ratio, limit, "times", "The median ball lies within the file's tolerances."), None
    stated = "its covariance"
    remedy = ""
    if frame.covariance_mm2 is None:
        most = _bead_of_most(frame, measured)
        stated = f"its tolerance ({frame.effective_tolerances.bead_mm:g} mm)"
        like = frame.name if frame.name in SOLIDS else "FILE"
        remedy = f": sightline frame new NEW.json --like {like} --bead-sd {most:g}, and fit to NEW.json"
    shown = f": they are {most:g} mm off per axis, 1 s.d." if most else "."
    start = f"The balls lie {ratio:.1f} times as far from the frame file as {stated} and the instrument explain{shown}"
    if min(counts) >= MIN_SERIES:
        return Check(name, True, ratio, None, "times", f"{start} Two series confirm their measured places."), most
    sentence = (
        f"{start} If the frame was made no better, state that{remedy}. If it was, the measurement is in error: measure "
        "a second series."
    )
    return Check(name, False, ratio, limit, "times", sentence), most


def _bead_of_most(frame: Frame, measured: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Return the bead tolerance, mm, with which the median ball lies as far off as expected; two digits, rounded up."""
    low, high = max(frame.effective_tolerances.bead_mm, 1e-4), MAX_BEAD_MM
    while high > 1.02 * low:
        middle = float(np.sqrt(low * high))
        far = np.median(complete(_with_bead(frame, middle), *measured).sigma) > np.sqrt(chdtri(3, 0.5))
        low, high = (middle, high) if far else (low, middle)
    digit = 10.0 ** (np.floor(np.log10(high)) - 1)
    return float(f"{np.ceil(high / digit) * digit:.2g}")


def _deviation(adjusted: Adjusted, counts: Sequence[int], sigma: np.ndarray) -> Check:
    """Return the check that every ball beyond its tolerance was confirmed by a second series. `counts`: series by
    ball."""
    far = [k for k in np.argsort(-sigma) if sigma[k] > MAX_DEVIATION_SIGMA]
    doubtful = [k for k in far if counts[k] < MIN_SERIES]
    worst = doubtful[0] if doubtful else int(np.argmax(sigma))
    names = _some([f"{adjusted.ids[k]} ({sigma[k]:.1f})" for k in (doubtful or far)])
    if doubtful:
        sentence = (
            f"Balls lie further off than tolerances and instrument explain (s.d. in brackets): {names}. A number is "
            "wrong, or a ball is misplaced: measure them again as a second series; where both agree, the measured "
            "places are used."
        )
    elif far:
        sentence = (
            f"Balls beyond their tolerance, confirmed by a second series: {names}. Their measured places are used."
        )
    else:
        sentence = "No ball lies further from the others than tolerances and instrument explain."
    return Check("measured deviation", not doubtful, float(sigma[worst]), MAX_DEVIATION_SIGMA, "s.d.", sentence)
