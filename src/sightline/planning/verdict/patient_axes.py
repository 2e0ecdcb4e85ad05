"""The patient's axes in the coordinates of a frame: those of a frame with plates, or those that the bone shows.

A procedure's file states directions of the bone (`BoneDirection`). The first two, as located in space, tell how the
patient lies; the third tells the side, since a left bone is the mirror image of a right one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import response
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.directions import ANTERIOR, MEDIAL, across, caudal, unit
from sightline.planning.bone.tube import line_of_tube
from sightline.planning.procedures.document import AidType, BoneDirection, ProcedureDocument

# Middle and axis (K, 3) of a part, of K sets of its numbers and its name.
_Of = Callable[[np.ndarray, str], np.ndarray]
_MIDDLES: Mapping[AidType, _Of] = {
    "point": lambda part, name: part[:, :3],
    "sphere": lambda part, name: part[:, :3],
    "line": lambda part, name: (part[:, :3] + part[:, 3:]) / 2,
    "plane": lambda part, name: part[:, :3],
    "cylinder": lambda part, name: part[:, :3],
    "rim pair": lambda part, name: (part[:, :3] + part[:, 3:]) / 2,
    "outline tube": lambda part, name: line_of_tube(part.reshape(-1, 2, 5, 3), name)[0],
}
_AXES: Mapping[AidType, _Of] = {
    "line": lambda part, name: part[:, 3:] - part[:, :3],
    "plane": lambda part, name: part[:, 3:],
    "cylinder": lambda part, name: part[:, 3:6],
    "rim pair": lambda part, name: part[:, 3:] - part[:, :3],
    "outline tube": lambda part, name: line_of_tube(part.reshape(-1, 2, 5, 3), name)[1],
}


@dataclass(frozen=True, eq=False)
class BoneAxes:
    """Directions of the bone as far as they are located: `document` names them.

    `landmarks`: the keys of the picked landmarks, in the order of the part "landmarks".
    """

    found: Anatomy
    document: ProcedureDocument
    landmarks: Sequence[str]
    side: str

    def lacking(self, directions: Sequence[BoneDirection]) -> list[str]:
        """Return what is missing of some directions, each as a clause that says what to do."""
        names = {one.key: one.name for one in self.document.landmarks}
        out = []
        for key in dict.fromkeys(key for one in directions for key in (*one.from_, *one.to, one.along) if key):
            if key in names and key not in self.landmarks:
                out.append(f"the landmark '{names[key]}' is not picked: pick it in both images and name it")
            elif key not in (*names, "entry", "end") and key not in self.found.at:
                out.append(self.found.why_absent(key))
        return out

    def axes(self, values: np.ndarray) -> np.ndarray:
        """Return lateral, caudal and anterior (K, 3, 3) as rows, CFCS, of K sets of `Anatomy.values`."""
        measured = self._triad(*(self._vector(one, values) for one in self.document.directions[:2]))
        nominal = self._triad(*(one.nominal[None] for one in self.document.directions[:2]))
        # A left bone is mirrored: the third axis of its nominal triad points the other way.
        nominal = nominal * [[1.0], [1.0], [1.0 if self.side == "right" else -1.0]]
        return np.swapaxes(nominal, 1, 2) @ measured

    def scatter_rad2(self) -> np.ndarray:
        """Return the covariance (3, 3) of a small rotation of the axes: by how much bones differ from the nominal."""
        first, second = (one.nominal for one in self.document.directions[:2])
        a, b = np.deg2rad([one.sd_deg for one in self.document.directions[:2]])
        about = np.outer(first, first)
        return a**2 * (np.eye(3) - about) + b**2 / float(np.sum(across(second, first) ** 2)) * about

    def beside(self) -> tuple[float, float]:
        """Return how far the third direction points to where it points in a patient of the stated side, mm, and the
        standard deviation of that."""
        first, second, third = self.document.directions
        way = np.sign(np.cross(first.nominal, second.nominal) @ third.nominal) * (1 if self.side == "right" else -1)

        def value(values: np.ndarray) -> np.ndarray:
            a, b, c = (self._vector(one, values) for one in (first, second, third))
            return way * (unit(np.cross(a, b)) * c).sum(axis=-1, keepdims=True)

        (at,), (own,) = response(value, self.found.values)
        length = float(np.linalg.norm(self._vector(third, self.found.values[None])))
        scatter = length**2 * float(np.linalg.eigvalsh(self.scatter_rad2())[-1])
        return float(at), float(np.sqrt(own @ self.found.covariance @ own + scatter))

    @staticmethod
    def _triad(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        along = unit(first)
        beside = unit(across(second, along))
        return np.stack([along, beside, np.cross(along, beside)], axis=1)

    def _vector(self, one: BoneDirection, values: np.ndarray) -> np.ndarray:
        """Return a direction (K, 3), mm."""
        start, stop = (np.mean([self._point(key, values) for key in keys], axis=0) for keys in (one.from_, one.to))
        if one.along is None:
            return stop - start
        axis = _AXES[self._type(one.along)](values[:, self.found.at[one.along]], one.along)
        return axis * np.sign(axis[0] @ (stop - start)[0])

    def _point(self, key: str, values: np.ndarray) -> np.ndarray:
        if key in ("entry", "end"):
            return values[:, self.found.at["wire"]][:, slice(0, 3) if key == "entry" else slice(3, 6)]
        if key in self.landmarks:
            first = self.found.at["landmarks"].start + 3 * list(self.landmarks).index(key)
            return values[:, first : first + 3]
        return _MIDDLES[self._type(key)](values[:, self.found.at[key]], key)

    def _type(self, key: str) -> AidType:
        return next(one.type for one in self.document.aids if one.key == key)


def frame_axes(side: str | None) -> np.ndarray:
    """Return lateral, caudal and anterior (3, 3) as rows, CFCS of a frame with plates; without a side of a right one.

    Raises UnusableInputError.
    """
    return np.stack([-MEDIAL, caudal(side or "right"), ANTERIOR])
