"""Seeds: similarities between plate and image from three detections matched to three datum markers."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sightline.common.fitting import median
from sightline.common.kernels import kernel
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections

MAX_SEEDS = 12  # of each plate [ours]
MAX_LARGE = 32  # detections tried as datum markers: 12 datums, 10 false ones, and a margin [twin]
LARGER = 1.12  # than the median detection: half the step from 3 to 5 mm, 1.29, over 1.15 for the plates' scales [calc]
MIN_PITCH_PX = 10.0  # in the image: beads of the least radius, 2 px, with gaps of 1.5 diameters [calc]
RADIUS_RATIO = 0.25  # largest log ratio of detected and expected radius: blur, local magnification, tilt [ours]
RADIUS_SPREAD = 0.2  # of that log ratio among the fiducials of a plate; below half the step from 3 to 5 mm, 0.26 [calc]
THIRD = 0.14  # gate of the third datum over the span: tilt 20° 0.06, pincushion 9 % [physics.md, Distortion]
REACH = 0.3  # gate of the other beads over the pitch: nearer to their place than to the next [ours]
CELLS = 48
NEAR = 5  # cells: REACH times a pitch of a third of the image; plates are finer [calc]


def complex_points(xy: np.ndarray) -> np.ndarray:
    """Return points (N, 2) as complex numbers x + iy (N,)."""
    return np.ascontiguousarray(xy).view(np.complex128)[:, 0]


def real_points(z: np.ndarray) -> np.ndarray:
    """Return complex numbers x + iy (N,) as points (N, 2)."""
    return z.view(np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class Similarity:
    """Map from plate to image: u + iv = `rotation` z + `shift` (px/mm, px), z = x + iy or its conjugate if `mirror`."""

    rotation: complex
    shift: complex
    mirror: bool

    @property
    def scale(self) -> float:
        """Pixels per mm."""
        return abs(self.rotation)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return pixels (N, 2) of plate points (N, 2), mm."""
        z = complex_points(xy_mm)
        return real_points(self.rotation * (z.conj() if self.mirror else z) + self.shift)

    def to_plate(self, uv_px: np.ndarray) -> np.ndarray:
        """Return plate points (N, 2), mm, of pixels (N, 2)."""
        z = (complex_points(uv_px) - self.shift) / self.rotation
        return real_points(z.conj() if self.mirror else z)


@dataclass(frozen=True, eq=False)
class Seed:
    """A hypothesis for one plate: detections `rows` are its fiducials `places`; `score` counts agreeing beads."""

    pattern: Pattern
    similarity: Similarity
    rows: np.ndarray
    places: np.ndarray
    score: float


class _Beads(NamedTuple):
    """The detections of an image in the form that kernels need: `w` (N,) centres u + iv, px; `log_radius` (N,).

    `nearest` (CELLS, CELLS): the detection nearest to the middle of each cell of the image, or -1; `rows`, `columns`:
    cells per pixel.
    """

    w: np.ndarray
    log_radius: np.ndarray
    nearest: np.ndarray
    rows: float
    columns: float


class _Plate(NamedTuple):
    """A pattern for kernels: `z` (P,) places x + iy, mm; `log_half` (P,) log radii; `datums` (D,) indices of datums."""

    z: np.ndarray
    log_half: np.ndarray
    datums: np.ndarray
    pitch: float


class _Triple(NamedTuple):
    """Three detections `rows` matched to three `places`, with the similarity that fits them best.

    `level`: mean log ratio of their radii to those that the similarity predicts.
    """

    rows: tuple[int, int, int]
    places: tuple[int, int, int]
    rotation: complex
    shift: complex
    mirror: bool
    level: float


class _Best(NamedTuple):
    """The best triples so far, best first, and their number `filled` (1,).

    `scores` (K,); `what` (K, 7): three detections, their places, whether mirrored; `moves` (K, 2): rotation and shift.
    `least`: the score that all of them exceed.
    """

    least: float
    filled: np.ndarray
    scores: np.ndarray
    what: np.ndarray
    moves: np.ndarray


def _nearest_table(w: np.ndarray, usable: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the usable detection nearest to the middle of each of CELLS x CELLS cells of the image, or -1.

    Only those within NEAR cells count.
    """
    rows, middles = np.flatnonzero(usable), np.arange(CELLS) + 0.5
    u, v = (real_points(w[rows]) * CELLS / (width, height)).T[:, :, None]
    du, dv = (u - middles) * width / CELLS, (v - middles) * height / CELLS
    du[np.abs(np.floor(u) + 0.5 - middles) > NEAR] = np.inf
    dv[np.abs(np.floor(v) + 0.5 - middles) > NEAR] = np.inf
    table, nearest = np.full((CELLS, CELLS), -1), np.full((CELLS, CELLS), np.inf)
    for k, row in enumerate(rows.tolist()):
        squares = dv[k, :, None] ** 2 + du[k] ** 2
        closer = squares < nearest
        table[closer], nearest[closer] = row, squares[closer]
    return table


@kernel()
def square(z):
    """Return the squared modulus of a complex number."""
    return z.real**2 + z.imag**2


@kernel()
def _laid(z, mirror):
    """Return a place of the plate, conjugated if mirrored."""
    return z.conjugate() if mirror else z


@kernel()
def _score(triple, plate, beads, least):
    """Return the number of beads in place, less half of those with a wrong size and a third of the missing ones.

    Minus infinity where the score cannot exceed `least`.
    """
    score, z, log_half = 0.0, plate.z, plate.log_half
    w, log_radius, nearest = beads.w, beads.log_radius, beads.nearest
    reach2 = (REACH * plate.pitch) ** 2 * square(triple.rotation)
    for p in range(len(z)):
        if score + (len(z) - p) <= least:
            return -np.inf
        at = triple.rotation * _laid(z[p], triple.mirror) + triple.shift
        i, j = int(at.imag * beads.rows), int(at.real * beads.columns)
        if i < 0 or j < 0 or i >= CELLS or j >= CELLS:
            continue
        k = nearest[i, j]
        if k >= 0 and square(w[k] - at) < reach2:
            score += 1.0 if abs(log_radius[k] - log_half[p] - triple.level) < RADIUS_SPREAD else -0.5
        else:
            score -= 0.33
    return score


@kernel()
def _fitted(beads, plate, rows, places, mirror, ratios):  # noqa: PLR0917 - a kernel
    """Return the least-squares triple of detections `rows` and `places`.

    `ratios`: log ratios of their radii, in mm by the pair's scale, to those of the places.
    """
    (i, j, k), (pa, pb, pc), w = rows, places, beads.w
    za, zb, zc = _laid(plate.z[pa], mirror), _laid(plate.z[pb], mirror), _laid(plate.z[pc], mirror)
    zm, wm = (za + zb + zc) / 3, (w[i] + w[j] + w[k]) / 3
    da, db, dc = za - zm, zb - zm, zc - zm
    top = w[i] * da.conjugate() + w[j] * db.conjugate() + w[k] * dc.conjugate()
    rotation = top * (1.0 / (square(da) + square(db) + square(dc)))
    level = (ratios[0] + ratios[1] + ratios[2]) / 3 + 0.5 * np.log(square(rotation))
    return _Triple(rows, places, rotation, wm - rotation * zm, mirror, level)


@kernel()
def _offer(triple, plate, beads, best):
    """Insert a triple into the sorted best ones, if it is one of them; the worst is dropped when they are full."""
    scores, what, moves = best.scores, best.what, best.moves
    full = best.filled[0] == len(scores)
    score = _score(triple, plate, beads, scores[-1] if full else best.least)
    if score == -np.inf:
        return
    if not full:
        best.filled[0] += 1
    at = best.filled[0] - 1
    while at > 0 and scores[at - 1] < score:
        scores[at], moves[at, 0], moves[at, 1] = scores[at - 1], moves[at - 1, 0], moves[at - 1, 1]
        for c in range(7):
            what[at, c] = what[at - 1, c]
        at -= 1
    scores[at], moves[at, 0], moves[at, 1] = score, triple.rotation, triple.shift
    for c in range(3):
        what[at, c], what[at, 3 + c] = triple.rows[c], triple.places[c]
    what[at, 6] = triple.mirror


@kernel()
def _search(beads, plate, rows, log_side, best):  # noqa: PLR0912 - a kernel
    """Fill `best` with the similarities that map three datum markers to three large detections, `rows`.

    `log_side` (D, D): the log distances, mm, between the datum markers.
    """
    w, z, log_r, datums, log_half = beads.w, plate.z, beads.log_radius, plate.datums, plate.log_half
    if len(z) <= best.least:  # no score can exceed it
        return
    log_least = np.log(MIN_PITCH_PX / plate.pitch)
    us, vs, log_rs = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    for m in range(len(rows)):
        us[m], vs[m], log_rs[m] = w[rows[m]].real, w[rows[m]].imag, log_r[rows[m]]
    for i in rows:
        for j in rows:
            if i == j:
                continue
            origin, gap = w[i], w[j] - w[i]
            span2 = square(gap)
            log_gap = 0.5 * np.log(span2)
            for a in range(len(datums)):
                pa = datums[a]
                for b in range(a + 1, len(datums) - 1):
                    pb, log_scale = datums[b], log_gap - log_side[a, b]
                    ratio_i, ratio_j = log_r[i] - log_half[pa] - log_scale, log_r[j] - log_half[pb] - log_scale
                    alike = abs(ratio_i - ratio_j) <= RADIUS_SPREAD and abs(ratio_i + ratio_j) <= 2 * RADIUS_RATIO
                    if not alike or log_scale < log_least:
                        continue
                    side, mean_ratio = z[pb] - z[pa], (ratio_i + ratio_j) / 2
                    per_side = side.conjugate() / square(side)
                    for mirror in (False, True):
                        for c in range(b + 1, len(datums)):
                            pc = datums[c]
                            share = (z[pc] - z[pa]) * per_side  # of the side: its place is that share of the gap
                            reach2 = THIRD**2 * span2 * max(1.0, square(share), square(share - 1.0))
                            want, level = origin + gap * _laid(share, mirror), log_half[pc] + log_scale
                            near, u, v = 0, want.real, want.imag
                            for m in range(len(us)):  # vectorised; seldom is any near
                                close = (us[m] - u) ** 2 + (vs[m] - v) ** 2 <= reach2
                                near += close & (abs(log_rs[m] - level - mean_ratio) <= RADIUS_SPREAD)
                            for m in range(len(rows) if near else 0):
                                k, ratio = rows[m], log_rs[m] - level
                                close = (us[m] - u) ** 2 + (vs[m] - v) ** 2 <= reach2
                                if close and abs(ratio - mean_ratio) <= RADIUS_SPREAD and k != i and k != j:  # noqa: PLR1714 - a tuple takes longer
                                    places, ratios = (pa, pb, pc), (ratio_i, ratio_j, ratio)
                                    triple = _fitted(beads, plate, (i, j, k), places, mirror, ratios)
                                    _offer(triple, plate, beads, best)


def find_seeds(detections: Detections, patterns: list[Pattern], usable: np.ndarray) -> Iterator[Seed]:
    """Yield the MAX_SEEDS best seeds of each plate among the `usable` (N,) detections, best first.

    The very best of all plates, which usually suffices, is searched for alone: far fewer triples can still become it.
    """
    height, width = detections.image_shape
    w = complex_points(detections.uv_px)
    table = _nearest_table(w, usable, width, height)
    beads = _Beads(w, np.log(detections.radius_px), table, CELLS / height, CELLS / width)
    washer = np.array(detections.kind, dtype=object) == "washer"
    kinds = {pattern.datum_kind for pattern in patterns}
    may_be = {kind: _may_be_datums(detections.radius_px, washer, kind, usable) for kind in kinds}
    for count, ranks in ((1, slice(1)), (MAX_SEEDS, slice(1, None))):
        for seed in _best_seeds(beads, patterns, may_be, count)[ranks]:
            if seed.similarity.rotation != 0:  # 0: so far from the image that rounding removes its pixels
                yield seed


def _best_seeds(beads: _Beads, patterns: list[Pattern], may_be: dict[str, np.ndarray], most: int) -> list[Seed]:
    """Return the `most` best seeds of each plate, best first; `may_be`: rows of possible datum markers by kind.

    Where one is wanted, those that are worse than a previous plate's are left out: plates with more fiducials, whose
    scores are higher, come first.
    """
    counts, scores = np.zeros((len(patterns), 1), np.int64), np.empty((len(patterns), most))
    what, moves = np.empty((len(patterns), most, 7), np.int64), np.empty((len(patterns), most, 2), np.complex128)
    guesses, least = [], -np.inf
    for k in sorted(range(len(patterns)), key=lambda k: -len(patterns[k].z)):
        pattern = patterns[k]
        plate = _Plate(pattern.z, pattern.log_half, pattern.datums, pattern.pitch_mm)
        datums, best = plate.z[plate.datums], _Best(least, counts[k], scores[k], what[k], moves[k])
        with np.errstate(divide="ignore"):
            log_side = np.log(np.abs(datums - datums[:, None]))
        _search(beads, plate, may_be[pattern.datum_kind], log_side, best)
        guesses += [(score, k, i) for i, score in enumerate(scores[k, : counts[k, 0]].tolist())]
        least = max(guesses)[0] if most == 1 and guesses else least
    seeds = []
    for score, k, i in sorted(guesses, key=lambda guess: -guess[0]):
        rotation, shift = moves[k, i].tolist()
        similarity = Similarity(rotation, shift, bool(what[k, i, 6]))
        seeds.append(Seed(patterns[k], similarity, what[k, i, :3], what[k, i, 3:6], score))
    return seeds


def _may_be_datums(radius_px: np.ndarray, washer: np.ndarray, kind: str, usable: np.ndarray) -> np.ndarray:
    """Return the rows of detections that may be datum markers of a kind: washers (N,), or the largest balls."""
    if kind == "washer":
        may_be = usable & washer
    elif usable.any():
        may_be = usable & ~washer & (radius_px > LARGER * median(radius_px[usable]))
    else:
        may_be = usable
    return np.flatnonzero(may_be)[np.argsort(-radius_px[may_be], kind="stable")[:MAX_LARGE]]


def best_similarity(xy_mm: np.ndarray, uv_px: np.ndarray) -> Similarity:
    """Return the least-squares similarity from plate points (N, 2) to pixels (N, 2), with the better handedness."""
    w, plain = complex_points(uv_px), complex_points(xy_mm)
    fits: list[tuple[float, Similarity]] = []
    for mirror in (False, True):
        z = plain.conj() if mirror else plain
        dz, dw = z - z.mean(), w - w.mean()
        rotation = complex(np.vdot(dz, dw) / np.vdot(dz, dz))
        miss = float((np.abs(dw - rotation * dz) ** 2).sum())
        fits.append((miss, Similarity(rotation, complex(w.mean() - rotation * z.mean()), mirror)))
    return min(fits, key=lambda fit: fit[0])[1]
