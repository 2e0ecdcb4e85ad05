"""`label`: which fiducial of which plate each detection is, or a refusal."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sightline.detection.labelling import joint
from sightline.detection.labelling.growth import Grown, grow
from sightline.detection.labelling.naming import Naming, name
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.labelling.seeds import Seed, find_seeds
from sightline.detection.results import Detections, Observations
from sightline.errors import LabellingRefusedError
from sightline.frame import Frame

LEAST_BEADS = 8  # of each plate [ours]
SEEDS = 12  # of each plate [ours]
MOST_FIRST, MOST_SECOND = 4, 2  # lattices tried before giving up [ours]
MARGIN = 6.0  # log odds by which any other reading must cost more: one and a half misjudged sizes [ours]
GATE_M2 = 11.8  # squared distance of a bead from its place, 2 degrees of freedom: 99.7 % [ours]
LOG_RADIUS_GATE = (0.1, 3.5, 0.25)  # at least, standard deviations, at most [ours]
MOST_FITS = 8
WORST_FACTOR = 9.0  # of the stated noise variance that the beads' residuals may show [ours]
FOCAL_MM = (250.0, 3000.0)  # from the source plate; 770 mm at the design distance [ours]
FOCAL_TILT = 0.7  # tangent of the beam's angle to the plates: 35° [ours]


@dataclass(frozen=True, eq=False)
class _Labelled:
    view: str
    ids: list[str]
    rows: np.ndarray
    mirrored: bool


def _lattices(every: tuple[Pattern, ...], detections: Detections, usable: np.ndarray, most: int) -> Iterator[Grown]:
    """Lattices of beads among the usable detections, the most promising first, each only once."""
    seeds = [seed for p in every for seed in find_seeds(detections, p, usable, SEEDS)]
    seeds.sort(key=lambda seed: -seed.score)
    taken: list[np.ndarray] = []
    for seed in seeds:
        if any(np.isin(seed.rows, rows).sum() >= 2 for rows in taken):
            continue
        one = grow(seed, detections, usable)
        if len(one) < LEAST_BEADS:
            continue
        taken.append(one.rows)
        yield one
        if len(taken) == most:
            return


def _regrown(grown: Grown, pattern: Pattern, places: np.ndarray, detections: Detections, usable) -> Grown:
    """The lattice again, under the name that was found for it."""
    kept = places >= 0
    rows, places = grown.all_rows[kept], places[kept]
    first = pattern.xy_mm[places] @ np.array([1.0, 1j])
    second = detections.uv_px[rows] @ np.array([1.0, 1j])
    from sightline.detection.labelling.seeds import best_similarity

    return grow(Seed(pattern, best_similarity(first, second), rows, places, 0.0), detections, usable)


def _named(pair: tuple[Grown, Grown], couples, detections: Detections, usable) -> tuple[tuple[Grown, Grown], Naming]:
    naming = name(pair, couples)
    if naming is None:
        raise LabellingRefusedError("no lattice")
    for _ in range(2):
        again = [
            _regrown(g, p, at, detections, usable)
            for g, p, at in zip(pair, naming.patterns, naming.places, strict=True)
        ]
        pair = (again[0], again[1])
        naming = name(pair, couples)
        if naming is None:
            raise LabellingRefusedError("no lattice")
        if all(
            p is g.pattern and np.array_equal(at, g.all_places)
            for g, p, at in zip(pair, naming.patterns, naming.places, strict=True)
        ):
            break
    else:
        raise LabellingRefusedError("the naming does not settle")
    if pair[0].pattern.role == "source":
        pair = (pair[1], pair[0])
    return pair, naming


def _assign(pair: tuple[Grown, Grown], fit: joint.Joint, factor: float) -> np.ndarray:
    """(B, 2) beads: detections on places, within the gates, alone there."""
    n = len(pair[0].pattern.ids)
    m2 = ((fit.xy_mm[:, None] - fit.target_mm[None]) ** 2).sum(axis=2) / fit.variance_mm2[:, None]
    sized = np.zeros(m2.shape, dtype=bool)
    for g, columns in zip(pair, (slice(0, n), slice(n, None)), strict=True):
        log_half = np.log(g.pattern.diameter_mm / 2)
        off = g.log_ratio[:, None] - log_half[None]
        own = g.log_ratio[g.rows] - log_half[g.places]
        least, sds, most = LOG_RADIUS_GATE
        gate = np.clip(sds * 1.4826 * np.median(np.abs(own - np.median(own))), least, most)
        sized[:, columns] = np.abs(off - np.median(own)) < gate
    near = (m2 < 2 * GATE_M2) & sized
    alone = near & (near.sum(axis=0) == 1)[None] & (near.sum(axis=1) == 1)[:, None]
    return np.argwhere(alone & (m2 < GATE_M2))


def _fitted(pair: tuple[Grown, Grown], detections: Detections) -> tuple[np.ndarray, joint.Joint, float]:
    n = len(pair[0].pattern.ids)
    beads = np.concatenate(
        [np.stack([pair[0].rows, pair[0].places], axis=1), np.stack([pair[1].rows, pair[1].places + n], axis=1)]
    )
    seen = pair[0].pattern.plane.to_space(pair[0].xy_mm[pair[1].rows])
    focal = joint.meeting_point(seen, pair[1].pattern.xyz_mm[pair[1].places])
    factor = 4.0
    fit = joint.fit(pair, beads, detections, focal, factor)
    for _ in range(MOST_FITS):
        factor = float(np.clip(factor * np.median(fit.m2) / 1.386, 0.5, 2 * WORST_FACTOR))
        new = _assign(pair, fit, factor)
        if min((new[:, 1] < n).sum(), (new[:, 1] >= n).sum()) < LEAST_BEADS:
            raise LabellingRefusedError("too few beads fit one central projection")
        fit = joint.fit(pair, new, detections, fit.focal_point_mm, factor)
        if np.array_equal(new, beads):
            return new, fit, factor
        beads = new
    raise LabellingRefusedError("the beads' labels do not settle")


def _check_projection(pair, fit: joint.Joint, factor: float, beads: np.ndarray) -> None:
    xrii, source = pair[0].pattern, pair[1].pattern
    if factor > WORST_FACTOR:
        raise LabellingRefusedError("residuals")
    away = xrii.plane.normal * np.sign(xrii.plane.height_mm(source.xyz_mm.mean(axis=0)))
    seen = xrii.plane.to_space(fit.target_mm[beads[:, 1]].mean(axis=0))
    ray = fit.focal_point_mm - seen
    far = ray @ away - abs(xrii.plane.height_mm(source.xyz_mm).mean())
    if not FOCAL_MM[0] < far < FOCAL_MM[1] or np.linalg.norm(ray - (ray @ away) * away) > FOCAL_TILT * (ray @ away):
        raise LabellingRefusedError("focal point")


def _solved(pair, couples, detections, usable) -> _Labelled:
    pair, naming = _named(pair, couples, detections, usable)
    if naming.margin < MARGIN:
        raise LabellingRefusedError("ambiguous")
    if pair[0].sheet.similarity.mirror != pair[1].sheet.similarity.mirror:
        raise LabellingRefusedError("handedness")
    beads, fit, factor = _fitted(pair, detections)
    _check_projection(pair, fit, factor, beads)
    if len(beads) < 0.6 * len(detections):
        raise LabellingRefusedError("unexplained")
    ids = pair[0].pattern.ids + pair[1].pattern.ids
    plane, source = pair[0].pattern.plane, pair[1].pattern
    along = plane.height_mm(source.xyz_mm.mean(axis=0)) < 0
    return _Labelled(
        pair[0].pattern.view, [ids[p] for p in beads[:, 1]], beads[:, 0], bool(pair[0].sheet.similarity.mirror == along)
    )


def label(
    detections: Detections,
    frame: Frame,
    view: str | None = None,
    datums: dict[str, tuple[float, float]] | None = None,
) -> Observations:
    """Tell the beads of one image apart."""
    every = patterns(frame)
    couples = list(zip(every[::2], every[1::2], strict=True))
    usable = np.array([kind != "hole" for kind in detections.kind])
    reasons: list[str] = []
    for first in _lattices(every, detections, usable, MOST_FIRST):
        rest = usable.copy()
        rest[first.rows] = False
        for second in _lattices(every, detections, rest, MOST_SECOND):
            try:
                found = _solved((first, second), couples, detections, usable)
            except LabellingRefusedError as refusal:
                reasons.append(str(refusal))
                continue
            return Observations(
                view=found.view,
                ids=tuple(found.ids),
                uv_px=detections.uv_px[found.rows],
                covariance_px2=detections.covariance_px2[found.rows],
                mirrored=found.mirrored,
                image_shape=detections.image_shape,
            )
    raise LabellingRefusedError(f"no: {reasons}")
