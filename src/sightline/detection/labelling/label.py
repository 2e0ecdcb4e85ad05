"""`label`: which fiducial of which plate each detection is, or a refusal."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from sightline.detection.labelling.checks import AttemptError, Stage
from sightline.detection.labelling.growth import Grown, grow
from sightline.detection.labelling.naming import most_like
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.labelling.seeds import Seed, best_similarity, find_seeds
from sightline.detection.labelling.solve import LEAST_BEADS, LabellingProblem, LabellingSolution, solve
from sightline.detection.results import Detections, Observations, Rejected
from sightline.errors import LabellingRefusedError, ObservationsError, UnusableInputError
from sightline.frame import Frame

SEEDS = 12  # of each plate [ours]
MOST_FIRST, MOST_SECOND, MOST_GROWN = 4, 3, 12  # lattices tried before giving up [ours]
LEFT_OVER = 0.4  # of a lattice's beads: fewer detections besides them are no second plate [ours]
SAME_SHAPE = 1.05  # ratio of the sides of triangles that are the same but for their scale [ours]
CLICK = 1.5  # how far a pixel given for a datum may be from the bead's centre, in radii [ours]
MAY_BE_TWO = "it may be two beads of the frame, or a false bead"
LEAST_SPREAD = 0.25  # rms distance of a plate's given datums from one line, in pitches [ours]


def label(
    detections: Detections,
    frame: Frame | str | Path,
    view: str | None = None,
    datums: Mapping[str, tuple[float, float]] | None = None,
) -> Observations:
    """Label the beads of one image: which fiducial of `frame` is seen where.

    `frame`: a Frame, a frame file or the name of a built-in frame.
    The pattern of datum markers tells view, plate and orientation; a `view` that contradicts it is refused. Detections
    that are not a bead of the frame, or might be two, are in `rejected`. `mirrored` is False where the image shows the
    frame as the X-ray source sees it. `datums`, fiducial id to pixel (u, v), is the paper's semi-automatic way (section
    4.2): three or more datum markers of each plate, from which the others are found.
    Raises LabellingRefusedError where the labels are not certain; FrameError for a view that the frame
    does not have; ObservationsError for `datums` that are not three fiducials of each plate of one view.
    """
    if not isinstance(detections, Detections):
        raise UnusableInputError(f"give the Detections of `detect`, not {type(detections).__name__}")
    frame = Frame.of(frame)
    if view is not None:
        frame.view(view)
    every = patterns(frame)
    couples = sorted(zip(every[::2], every[1::2], strict=True), key=lambda couple: couple[0].view != view)
    usable = np.array([kind != "hole" for kind in detections.kind], dtype=bool)
    if is_inverted(detections):
        raise LabellingRefusedError(
            f"inverted: {(~usable).sum()} bright balls were found and {usable.sum()} dark ones; read the image with "
            "--invert (in Python: read_image(path, invert=True))"
        )
    if usable.sum() < 2 * LEAST_BEADS:
        raise LabellingRefusedError(
            f"{usable.sum()} beads were found, and {LEAST_BEADS} of each plate are needed; check that the frame is in "
            "the field and the exposure is not too low or too high"
        )
    try:
        if datums is not None:
            problem = LabellingProblem(detections, usable, couples, view or _view_of(datums, frame), told=True)
            solution = solve(problem, _told(problem, datums))
        else:
            solution = _found(LabellingProblem(detections, usable, couples, view))
    except AttemptError as stop:
        raise LabellingRefusedError(str(stop)) from None
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


def _rejected(detections: Detections, usable: np.ndarray, solution: LabellingSolution) -> tuple[Rejected, ...]:
    """The dark detections that are not labelled: bright ones are holes, which no frame has."""
    left = usable.copy()
    left[solution.rows] = False
    reasons = np.where(solution.on_place, MAY_BE_TWO, "no single bead of the frame is expected there")
    return tuple(
        Rejected((float(u), float(v)), float(radius), str(reason))
        for (u, v), radius, reason in zip(
            detections.uv_px[left], detections.radius_px[left], reasons[left], strict=True
        )
    )


def is_inverted(detections: Detections) -> bool:
    """Whether the balls are bright in the image: as many bright spots as labels take, and too few dark ones."""
    bright = sum(kind == "hole" for kind in detections.kind)
    return len(detections) - bright < 2 * LEAST_BEADS <= bright


def _found(problem: LabellingProblem) -> LabellingSolution:
    """The first solution that stands; else the refusal of the attempt that came furthest. Raises AttemptError."""
    stops: list[AttemptError] = []
    lone: list[Grown] = []
    for first in _lattices(problem, problem.usable, MOST_FIRST):
        rest = problem.usable.copy()
        rest[first.rows] = False
        lone.append(first)
        for second in _lattices(problem, rest, MOST_SECOND):
            try:
                return solve(problem, (first, second))
            except AttemptError as stop:
                if stop.stage == Stage.FINAL:
                    raise
                stops.append(stop)
    largest = max(lone, key=len, default=None)
    if largest is not None and (not stops or problem.usable.sum() < (1 + LEFT_OVER) * len(largest)):
        raise _one_plate(problem, largest)
    if not stops:
        raise AttemptError(
            Stage.SEEDS,
            f"no three of the {problem.usable.sum()} beads found are datum markers of this frame; check that it is the "
            "frame in the image, show more of its datum markers, or give their pixels",
        )
    raise max(stops, key=lambda stop: stop.stage)


def _one_plate(problem: LabellingProblem, lattice: Grown) -> AttemptError:
    """What to say where no second plate is found."""
    best = most_like(lattice, [pattern for couple in problem.couples for pattern in couple])
    return AttemptError(
        Stage.LATTICES,
        f"only one plate was found: {len(lattice)} beads that look most like the {best.role_name} plate of the "
        f"{best.view} view; move the C-arm or the frame until both plates are in the field",
    )


def _lattices(problem: LabellingProblem, usable: np.ndarray, most: int) -> Iterator[Grown]:
    """Lattices of beads among the usable detections, the most promising first, each only once."""
    every = [pattern for couple in problem.couples for pattern in couple]
    known: list[Grown] = []
    tried = 0
    for seed in find_seeds(problem.detections, every, usable, SEEDS):
        if len(known) == most or tried == MOST_GROWN:
            return
        if any(_is_of(seed, one) for one in known):
            continue
        tried += 1
        one = grow(seed, problem.detections, usable)
        if len(one) >= LEAST_BEADS:
            known.append(one)
            yield one


def _is_of(seed: Seed, lattice: Grown) -> bool:
    """Whether a guess is a reading of a lattice that is known: its three beads lie alike in both, but for the scale."""
    if not np.isin(seed.rows, lattice.all_rows).all():
        return False
    ours, theirs = seed.pattern.xy_mm[seed.places], lattice.xy_mm[seed.rows]
    sides = np.linalg.norm(np.roll(theirs, 1, axis=0) - theirs, axis=1)
    ratio = sides / np.linalg.norm(np.roll(ours, 1, axis=0) - ours, axis=1)
    return bool(ratio.max() < SAME_SHAPE * ratio.min())


def _view_of(datums: Mapping[str, tuple[float, float]], frame: Frame) -> str:
    """The one view whose fiducials a person named. Raises ObservationsError."""
    for name, one in frame.views.items():
        if datums.keys() <= one.by_id.keys():
            return name
    raise ObservationsError("the datum markers given are not fiducials of one view of the frame; check their names")


def _told(problem: LabellingProblem, datums: Mapping[str, tuple[float, float]]) -> tuple[Grown, Grown]:
    """The lattices of both plates, from the pixels that a person gave. Raises ObservationsError and AttemptError."""
    couple = problem.couples[0] if problem.view is None else _couple(problem)
    first, second = (_told_plate(problem, pattern, datums) for pattern in couple)
    return first, second


def _couple(problem: LabellingProblem) -> tuple[Pattern, Pattern]:
    return next(couple for couple in problem.couples if couple[0].view == problem.view)


def _told_plate(problem: LabellingProblem, pattern: Pattern, datums: Mapping[str, tuple[float, float]]) -> Grown:
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
    if len(places) < 3 or np.linalg.svd(off)[1][1] / np.sqrt(len(off)) < LEAST_SPREAD * pattern.pitch_mm:
        raise ObservationsError(
            f"give three or more datum markers of the {pattern.role_name} plate that are not on one line"
        )
    similarity = best_similarity(pattern.xy_mm[places], detections.uv_px[rows])
    grown = grow(Seed(pattern, similarity, np.array(rows), np.array(places), 0.0), detections, problem.usable)
    if len(grown) < LEAST_BEADS:
        raise AttemptError(
            Stage.LATTICES,
            f"only {len(grown)} beads of the {pattern.role_name} plate lie where the datum markers given put them; "
            "check them",
        )
    return grown
