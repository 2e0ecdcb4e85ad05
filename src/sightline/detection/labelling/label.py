"""`label`: assign detections to the fiducials of a frame, or refuse."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from sightline.common.threads import one_blas_thread
from sightline.detection.labelling.growth import Grown, grow
from sightline.detection.labelling.naming import most_like
from sightline.detection.labelling.patterns import Pattern, detector_pattern, patterns
from sightline.detection.labelling.seeds import Seed, best_similarity, find_seeds
from sightline.detection.labelling.solve import (
    MIN_BEADS,
    AttemptError,
    LabellingProblem,
    LabellingSolution,
    Stage,
    solve,
)
from sightline.detection.results import Detections, Observations, RejectedCandidate
from sightline.errors import LabellingRefusedError, ObservationsError, UnusableInputError
from sightline.frame import Frame

MAX_FIRST, MAX_SECOND, MAX_GROWN = 4, 3, 12  # lattices tried before giving up: one for each view's plates [ours]
LEFT_OVER = 0.4  # of a lattice's beads: with fewer other detections there is no second plate [ours]
SAME_SHAPE = 1.05  # [ours] largest ratio of side ratios of triangles that count as similar: distortion makes a few %
CLICK = 1.5  # [ours] largest distance of a click on a datum from its centre, in radii: farther off, another is meant
MAY_BE_TWO = "may be two beads of the frame, or a false bead"
# Focal length of a flat panel's image over its longer side: panels of 20 to 43 cm, 0.8 to 1.6 m away [physics.md]
SOLID_FOCAL = (1.8, 8.0)
MIN_SPREAD = 0.25  # [ours] rms distance of given datums from one line, in pitches: nearer, mirror images fit as well


@one_blas_thread
def label(
    detections: Detections,
    frame: Frame | str | Path,
    view: str | None = None,
    datums: Mapping[str, tuple[float, float]] | None = None,
) -> Observations:
    """Return the detections of one image assigned to the fiducials of `frame`.

    `frame`: a Frame, a frame file or the name of a built-in frame. The pattern of datum markers identifies view, plate
    and orientation; a contradicting `view` is refused. `datums` maps fiducial ids to pixels (u, v), the paper's
    semi-automatic method (section 4.2): three or more datum markers of each plate, from which the others are found.
    The balls of a solid are labelled by geometry alone, in the image of a flat panel or, after those of a plate on the
    detector, in that of an intensifier; `view` is then needed.
    In the result, `rejected` holds detections that are not a bead of the frame, or might be two. `mirrored` is False
    where the image shows the frame as the X-ray source sees it.
    Raises LabellingRefusedError where the labels are not certain; FrameError for a view that the frame does not have;
    ObservationsError for `datums` that are not three fiducials of each plate of one view.

    >>> beads = sl.detect("out/demo/demo_pa.dcm")
    >>> sl.label(beads, "gamma").view
    'pa'
    """
    if not isinstance(detections, Detections):
        raise UnusableInputError(f"give the Detections of `detect`, not {type(detections).__name__}")
    frame = Frame.of(frame)
    if frame.solid is None and view is not None:
        frame.view(view)
    usable = np.array([kind != "hole" for kind in detections.kind], dtype=bool)
    least = 2 * MIN_BEADS
    if frame.solid is not None:
        from sightline.detection.labelling.cloud import MIN_MATCHED  # here: see `_of_solid`

        least = MIN_MATCHED
    if is_inverted(detections, least):
        raise LabellingRefusedError(
            f"inverted: {(~usable).sum()} bright balls were found and {usable.sum()} dark ones; read the image with "
            "--invert (in Python: read_image(path, invert=True))"
        )
    if frame.solid is None:
        solution = _of_plates(detections, usable, frame, view, datums)
    elif datums is not None:
        raise ObservationsError("a solid has no datum markers; label it without them")
    else:
        solution = _of_solid(detections, usable, frame, view)
    return Observations(
        view=solution.view,
        ids=solution.ids,
        uv_px=detections.uv_px[solution.rows],
        covariance_px2=detections.covariance_px2[solution.rows],
        mirrored=solution.mirrored,
        image_shape=detections.image_shape,
        pixels=detections.pixels,
        radius_px=detections.radius_px[solution.rows],
        rejected=_rejected(detections, usable, solution),
    )


def _of_plates(
    detections: Detections,
    usable: np.ndarray,
    frame: Frame,
    view: str | None,
    datums: Mapping[str, tuple[float, float]] | None,
) -> LabellingSolution:
    """Return the labels of the plates of one view. Raises what `label` raises."""
    every = patterns(frame)
    couples = sorted(zip(every[::2], every[1::2], strict=True), key=lambda couple: couple[0].view != view)
    if usable.sum() < 2 * MIN_BEADS:
        raise LabellingRefusedError(
            f"{usable.sum()} beads were found, and {MIN_BEADS} of each plate are needed; check that the frame is in "
            "the field and the exposure is not too low or too high"
        )
    try:
        if datums is not None:
            problem = LabellingProblem(detections, usable, couples, view or _view_of(datums, frame), given=True)
            return solve(problem, _given_lattices(problem, datums))
        return _first_solution(LabellingProblem(detections, usable, couples, view))
    except AttemptError as failure:
        raise LabellingRefusedError(str(failure)) from None


def _of_solid(detections: Detections, usable: np.ndarray, frame: Frame, view: str | None) -> LabellingSolution:
    """Return the labels of a solid, and of the plate on the detector. Raises LabellingRefusedError."""
    if view is None:
        raise LabellingRefusedError(
            "a block looks alike in every view: say which view the image is, --view pa, lateral or oblique (in Python: "
            "view='pa')"
        )
    # Here: a frame with plates does not need what solids take, 6 MB of scipy.spatial above all.
    from sightline.detection.labelling.cloud import label_cloud, label_plate

    solid, bead_sd_mm = frame.solid, frame.effective_tolerances.bead_mm
    assert solid is not None  # noqa: S101 - the caller asks
    if frame.detector is None:
        low, high = (factor * max(detections.image_shape) for factor in SOLID_FOCAL)
        match = label_cloud(detections, solid.xyz_mm, solid.diameter_mm, (low, high), bead_sd_mm)
        unclear = np.isin(np.arange(len(detections)), match.unclear)
        ids = tuple(solid.ids[ball] for ball in match.balls)
        return LabellingSolution(view, ids, match.rows, match.mirrored, unclear)
    plate = label_plate(detections, usable, detector_pattern(frame))
    rest, rows = plate.undistorted(detections)
    match = label_cloud(rest, solid.xyz_mm, solid.diameter_mm, plate.focal_px, bead_sd_mm)
    return LabellingSolution(
        view,
        (*(solid.ids[ball] for ball in match.balls), *plate.ids),
        np.concatenate([rows[match.rows], plate.rows]),
        plate.mirrored != match.mirrored,
        np.isin(np.arange(len(detections)), rows[match.unclear]),
    )


def _rejected(detections: Detections, usable: np.ndarray, solution: LabellingSolution) -> tuple[RejectedCandidate, ...]:
    """Return the dark detections that are not labelled; bright ones are holes, which no frame has."""
    left = usable.copy()
    left[solution.rows] = False
    reasons = np.where(solution.on_place, MAY_BE_TWO, "no single bead of the frame is expected there")
    return tuple(
        RejectedCandidate((float(u), float(v)), float(radius), str(reason))
        for (u, v), radius, reason in zip(
            detections.uv_px[left], detections.radius_px[left], reasons[left], strict=True
        )
    )


def is_inverted(detections: Detections, least: int = 2 * MIN_BEADS) -> bool:
    """Return whether the image is inverted: enough bright spots for labelling, `least`, and too few dark ones."""
    bright = sum(kind == "hole" for kind in detections.kind)
    return len(detections) - bright < least <= bright


def _first_solution(problem: LabellingProblem) -> LabellingSolution:
    """Return the first valid solution. Raises AttemptError, that of the attempt that came furthest."""
    failures: list[AttemptError] = []
    lone: list[Grown] = []
    for first in _lattices(problem, problem.usable, MAX_FIRST):
        rest = problem.usable.copy()
        rest[first.rows] = False
        lone.append(first)
        for second in _lattices(problem, rest, MAX_SECOND):
            try:
                return solve(problem, (first, second))
            except AttemptError as failure:
                if failure.stage == Stage.FINAL:
                    raise
                failures.append(failure)
    largest = max(lone, key=len, default=None)
    if largest is not None and (not failures or problem.usable.sum() < (1 + LEFT_OVER) * len(largest)):
        best = most_like(largest, [pattern for couple in problem.couples for pattern in couple])
        raise AttemptError(
            Stage.LATTICES,
            f"only one plate was found: {len(largest)} beads that look most like the {best.role_name} plate of the "
            f"{best.view} view; move the C-arm or the frame until both plates are in the field",
        )
    if not failures:
        raise AttemptError(
            Stage.SEEDS,
            f"no three of the {problem.usable.sum()} beads found are datum markers of this frame; check that it is the "
            "frame in the image, show more of its datum markers, or give their pixels",
        )
    raise max(failures, key=lambda failure: failure.stage)


def _lattices(problem: LabellingProblem, usable: np.ndarray, most: int) -> Iterator[Grown]:
    """Yield lattices of beads among the usable detections, the most promising first, each only once."""
    every = [pattern for couple in problem.couples for pattern in couple]
    known: list[Grown] = []
    tried = 0
    for seed in find_seeds(problem.detections, every, usable):
        if len(known) == most or tried == MAX_GROWN:
            return
        if any(_is_known(seed, lattice) for lattice in known):
            continue
        tried += 1
        lattice = grow(seed, problem.detections, usable)
        if len(lattice) >= MIN_BEADS:
            known.append(lattice)
            yield lattice


def _is_known(seed: Seed, lattice: Grown) -> bool:
    """Return whether a seed belongs to a known lattice: its three beads form similar triangles in both."""
    if not np.isin(seed.rows, lattice.all_rows).all():
        return False
    ours, theirs = seed.pattern.xy_mm[seed.places], lattice.xy_mm[seed.rows]
    sides = np.linalg.norm(np.roll(theirs, 1, axis=0) - theirs, axis=1)
    ratio = sides / np.linalg.norm(np.roll(ours, 1, axis=0) - ours, axis=1)
    return bool(ratio.max() < SAME_SHAPE * ratio.min())


def _view_of(datums: Mapping[str, tuple[float, float]], frame: Frame) -> str:
    """Return the view to which all given datum markers belong. Raises ObservationsError."""
    for name, view in frame.views.items():
        if datums.keys() <= view.by_id.keys():
            return name
    raise ObservationsError("the datum markers given are not fiducials of one view of the frame; check their names")


def _given_lattices(problem: LabellingProblem, datums: Mapping[str, tuple[float, float]]) -> tuple[Grown, Grown]:
    """Return the lattices of both plates from given datum pixels. Raises ObservationsError and AttemptError."""
    couple = next(couple for couple in problem.couples if problem.view in (None, couple[0].view))
    first, second = (_given_lattice(problem, pattern, datums) for pattern in couple)
    return first, second


def _given_lattice(problem: LabellingProblem, pattern: Pattern, datums: Mapping[str, tuple[float, float]]) -> Grown:
    detections = problem.detections
    rows, places = [], []
    for place, name in enumerate(pattern.ids):
        if name not in datums:
            continue
        distance = np.where(problem.usable, np.linalg.norm(detections.uv_px - datums[name], axis=1), np.inf)
        row = int(distance.argmin())
        if not distance[row] < CLICK * detections.radius_px[row]:
            raise AttemptError(
                Stage.SEEDS, f"no bead was found at the pixel given for {name}; give another datum marker instead"
            )
        rows.append(row)
        places.append(place)
    off = pattern.xy_mm[places] - pattern.xy_mm[places].mean(axis=0) if places else np.zeros((0, 2))
    if len(places) < 3 or np.linalg.svd(off)[1][1] / np.sqrt(len(off)) < MIN_SPREAD * pattern.pitch_mm:
        raise ObservationsError(
            f"give three or more datum markers of the {pattern.role_name} plate that are not on one line"
        )
    similarity = best_similarity(pattern.xy_mm[places], detections.uv_px[rows])
    grown = grow(Seed(pattern, similarity, np.array(rows), np.array(places), 0.0), detections, problem.usable)
    if len(grown) < MIN_BEADS:
        raise AttemptError(
            Stage.LATTICES,
            f"only {len(grown)} beads of the {pattern.role_name} plate lie where the datum markers given put them; "
            "check them",
        )
    return grown
