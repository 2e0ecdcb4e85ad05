"""First guesses: three detections taken for three datum markers of a plate give a similarity of plate and image."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections
from sightline.fitting.robust import median

MOST_LARGE = 32  # detections that may be datum markers [ours: 12 datums, 10 false ones, and room]
LARGER = 1.12  # than the median detection: half the step from 3 to 5 mm, less 15 % for the plates' scales [ours]
SMALLEST_PX = 10.0  # pitch in the image [ours: beads of 2 px radius and as much between them]
RADIUS_RATIO = 0.25  # log of detected over expected radius: blur, local magnification, tilt together [ours]
RADIUS_SPREAD = 0.2  # log radius between fiducials of one plate; half the step from 3 to 5 mm [ours]
THIRD = 0.14  # how far the third datum may miss its place, of the span: tilt 20°, 9 % pincushion [ours]
REACH = 0.3  # how far other beads may miss theirs, of the pitch: nearer to it than to the next bead's [ours]
CELLS = 48
NEAR = 5  # cells: REACH of a pitch of a third of the image, no plate being so coarse [calc]


@dataclass(frozen=True)
class Similarity:
    """Plate to image: u + iv = turn · z + shift with z = x + iy, or its conjugate where `mirror`. px/mm and px."""

    turn: complex
    shift: complex
    mirror: bool

    @property
    def scale(self) -> float:
        """Pixels per mm."""
        return abs(self.turn)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """(N, 2) mm to (N, 2) px."""
        z = xy_mm[:, 0] + 1j * xy_mm[:, 1]
        w = self.turn * (z.conj() if self.mirror else z) + self.shift
        return np.stack([w.real, w.imag], axis=1)

    def to_plate(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 2) px to (N, 2) mm."""
        z = (uv_px[:, 0] + 1j * uv_px[:, 1] - self.shift) / self.turn
        z = z.conj() if self.mirror else z
        return np.stack([z.real, z.imag], axis=1)


@dataclass(frozen=True, eq=False)
class Seed:
    """A guess for one plate: detections `rows` (3,) are its fiducials `places` (3,); `score` counts agreeing beads."""

    pattern: Pattern
    similarity: Similarity
    rows: np.ndarray
    places: np.ndarray
    score: float


@njit(cache=True, error_model="numpy")
def _nearest_table(w, usable, width, height):
    """Which detection is nearest to the middle of each of CELLS x CELLS cells of the image, -1 if none is near."""
    table, nearest = np.empty((CELLS, CELLS), np.int64), np.empty((CELLS, CELLS))
    for i in range(CELLS):
        for j in range(CELLS):
            table[i, j], nearest[i, j] = -1, np.inf
    for k in range(len(w)):
        ci, cj = int(w[k].imag * CELLS / height), int(w[k].real * CELLS / width)
        for i in range(max(ci - NEAR, 0), min(ci + NEAR + 1, CELLS) if usable[k] else 0):
            for j in range(max(cj - NEAR, 0), min(cj + NEAR + 1, CELLS)):
                d = (w[k].real - (j + 0.5) * width / CELLS) ** 2 + (w[k].imag - (i + 0.5) * height / CELLS) ** 2
                if d < nearest[i, j]:
                    table[i, j], nearest[i, j] = k, d
    return table


@njit(cache=True, error_model="numpy")
def _score(a, b, mirror, log_scale, z, log_half, pitch, w, log_r, table, width, height, least):  # noqa: PLR0917 - a kernel
    """Beads of the right size in place, less half of those of a wrong size, less a third of the missing.

    Minus infinity where it cannot be more than `least`.
    """
    score = 0.0
    reach2 = (REACH * pitch) ** 2 * (a.real**2 + a.imag**2)
    rows, columns = CELLS / height, CELLS / width
    for p in range(len(z)):
        if score + (len(z) - p) <= least:
            return -np.inf
        at = a * (z[p].conjugate() if mirror else z[p]) + b
        i, j = int(at.imag * rows), int(at.real * columns)
        if i < 0 or j < 0 or i >= CELLS or j >= CELLS:
            continue
        k = table[i, j]
        d = w[k] - at
        if k >= 0 and d.real**2 + d.imag**2 < reach2:
            score += 1.0 if abs(log_r[k] - log_half[p] - log_scale) < RADIUS_SPREAD else -0.5
        else:
            score -= 0.33
    return score


@njit(cache=True, error_model="numpy")
def _search(w, log_r, large, z, log_half, datums, pitch, table, width, height, scores, what, found):  # noqa: PLR0912, PLR0915, PLR0917 - a kernel
    """Fill in the best similarities that put three datum markers on three large detections, best first.

    `scores` (K,); `what` (K, 7): three detections, their places, whether mirrored; `found` (K, 2): turn and shift.
    Returns how many there are.
    """
    count, most = 0, len(scores)
    log_least = np.log(SMALLEST_PX / pitch)
    log_side = np.empty((len(datums), len(datums)))
    for na in range(len(datums)):
        for nb in range(na + 1, len(datums)):
            log_side[na, nb] = np.log(abs(z[datums[nb]] - z[datums[na]]))
    for i in large:
        for j in large:
            if i == j:
                continue
            gap = w[j] - w[i]
            span2 = gap.real**2 + gap.imag**2
            log_gap = 0.5 * np.log(span2)
            for na in range(len(datums)):
                for nb in range(na + 1, len(datums)):
                    pa, pb = datums[na], datums[nb]
                    log_scale = log_gap - log_side[na, nb]
                    ratio_i = log_r[i] - log_half[pa] - log_scale
                    ratio_j = log_r[j] - log_half[pb] - log_scale
                    if abs(ratio_i - ratio_j) > RADIUS_SPREAD or abs(ratio_i + ratio_j) > 2 * RADIUS_RATIO:
                        continue
                    if log_scale < log_least:
                        continue
                    side = z[pb] - z[pa]
                    side2 = side.real**2 + side.imag**2
                    for mirror in range(2):
                        a = gap * (side if mirror else side.conjugate()) / side2
                        for nc in range(nb + 1, len(datums)):
                            pc = datums[nc]
                            dz = z[pc] - z[pa]
                            step = a * (dz.conjugate() if mirror else dz)
                            want, rest = w[i] + step, step - gap
                            reach2 = THIRD**2 * max(span2, step.real**2 + step.imag**2, rest.real**2 + rest.imag**2)
                            for k in large:
                                off = w[k] - want
                                off2 = off.real**2 + off.imag**2
                                if off2 > reach2 or k == i or k == j:  # noqa: PLR1714, SIM109
                                    continue
                                ratio = log_r[k] - log_half[pc] - log_scale
                                if abs(ratio - (ratio_i + ratio_j) / 2) > RADIUS_SPREAD:
                                    continue
                                za, zb, zc = z[pa], z[pb], z[pc]
                                if mirror:
                                    za, zb, zc = za.conjugate(), zb.conjugate(), zc.conjugate()
                                zm, wm = (za + zb + zc) / 3, (w[i] + w[j] + w[k]) / 3
                                da, db, dc = za - zm, zb - zm, zc - zm
                                top = w[i] * da.conjugate() + w[j] * db.conjugate() + w[k] * dc.conjugate()
                                turn = top / (da * da.conjugate() + db * db.conjugate() + dc * dc.conjugate()).real
                                shift = wm - turn * zm
                                level = (ratio_i + ratio_j + ratio) / 3 + 0.5 * np.log(turn.real**2 + turn.imag**2)
                                least = scores[most - 1] if count == most else -np.inf
                                score = _score(
                                    turn,
                                    shift,
                                    mirror == 1,
                                    level,
                                    z,
                                    log_half,
                                    pitch,
                                    w,
                                    log_r,
                                    table,
                                    width,
                                    height,
                                    least,
                                )
                                if score == -np.inf:
                                    continue
                                count = min(count + 1, most)
                                at = count - 1
                                while at > 0 and scores[at - 1] < score:
                                    scores[at], found[at, 0], found[at, 1] = (
                                        scores[at - 1],
                                        found[at - 1, 0],
                                        found[at - 1, 1],
                                    )
                                    for c in range(7):
                                        what[at, c] = what[at - 1, c]
                                    at -= 1
                                scores[at], found[at, 0], found[at, 1] = score, turn, shift
                                what[at, 0], what[at, 1], what[at, 2] = i, j, k
                                what[at, 3], what[at, 4], what[at, 5], what[at, 6] = pa, pb, pc, mirror
    return count


def find_seeds(detections: Detections, patterns: list[Pattern], usable: np.ndarray, most: int) -> Iterator[Seed]:
    """The `most` best guesses for each plate among the `usable` (N,) detections, best first."""
    height, width = detections.image_shape
    w, log_r = detections.uv_px @ np.array([1.0, 1j]), np.log(detections.radius_px)
    table = _nearest_table(w, usable, width, height)
    may_be = {kind: _may_be_datums(detections, kind, usable) for kind in {pattern.datum_kind for pattern in patterns}}
    scores = np.empty((len(patterns), most))
    what, found = np.empty((len(patterns), most, 7), np.int64), np.empty((len(patterns), most, 2), np.complex128)
    guesses = []
    for k, pattern in enumerate(patterns):
        count = _search(
            w,
            log_r,
            may_be[pattern.datum_kind],
            pattern.z,
            pattern.log_half,
            pattern.datums,
            pattern.pitch_mm,
            table,
            width,
            height,
            scores[k],
            what[k],
            found[k],
        )
        guesses += [(score, k, i) for i, score in enumerate(scores[k, :count].tolist())]
    for score, k, i in sorted(guesses, key=lambda guess: -guess[0]):
        turn, shift = found[k, i].tolist()
        if turn == 0:  # so far from the image that its pixels are rounded away
            continue
        similarity = Similarity(turn, shift, bool(what[k, i, 6]))
        yield Seed(patterns[k], similarity, what[k, i, :3], what[k, i, 3:6], score)


def _may_be_datums(detections: Detections, kind: str, usable: np.ndarray) -> np.ndarray:
    """Rows of the detections that may be datum markers of a kind: washers, or the largest balls."""
    washer = np.array([one == "washer" for one in detections.kind], dtype=bool)
    radius = detections.radius_px
    if kind == "washer":
        may_be = usable & washer
    elif usable.any():
        may_be = usable & ~washer & (radius > LARGER * median(radius[usable]))
    else:
        may_be = usable
    return np.flatnonzero(may_be)[np.argsort(-radius[may_be], kind="stable")[:MOST_LARGE]]


def best_similarity(xy_mm: np.ndarray, uv_px: np.ndarray) -> Similarity:
    """The least-squares similarity of points (N, 2) of a plate and the image, of the handedness that fits better."""
    w = uv_px @ np.array([1.0, 1j])
    found: list[tuple[float, Similarity]] = []
    for mirror in (False, True):
        z = xy_mm @ np.array([1.0, -1j if mirror else 1j])
        dz, dw = z - z.mean(), w - w.mean()
        turn = complex(np.vdot(dz, dw) / np.vdot(dz, dz))
        miss = float((np.abs(dw - turn * dz) ** 2).sum())
        found.append((miss, Similarity(turn, complex(w.mean() - turn * z.mean()), mirror)))
    return min(found, key=lambda one: one[0])[1]
