"""What a simulator tells simulated imaging devices and no robot knows: where wire and frame truly are."""

from dataclasses import dataclass
from json import JSONDecodeError, dumps, loads

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError


@dataclass(frozen=True, eq=False)
class SimulatedWire:
    """`wire_mm` (3, 3) MCS: the wire's axis at its guide's mouth, where bone holds it (else halfway), and its tip, as
    they are now. `T_mcs_cfcs`: the frame as it stood when the images were taken, `imaged` (5,): the encoders then."""

    wire_mm: np.ndarray
    T_mcs_cfcs: RigidTransform
    imaged: np.ndarray

    @property
    def axis_mm(self) -> np.ndarray:
        """(2, 3): where it leaves its guide and its tip, CFCS of the images."""
        return self.T_mcs_cfcs.inv().apply(self.wire_mm[[0, 2]])

    def text(self) -> str:
        """As the link carries it."""
        values = {"wire_mm": self.wire_mm, "T_mcs_cfcs": self.T_mcs_cfcs.as_matrix(), "imaged": self.imaged}
        return dumps({name: value.tolist() for name, value in values.items()})

    @staticmethod
    def of(text: str) -> "SimulatedWire":
        """From such a text. Raises UnusableInputError."""
        try:
            said = loads(text)
            names = ("wire_mm", "T_mcs_cfcs", "imaged")
            wire, frame, imaged = (np.array(said[name], dtype=np.float64) for name in names)
        except (JSONDecodeError, KeyError, TypeError, ValueError) as error:
            raise UnusableInputError("this text does not say where a simulated wire is") from error
        finite = all(np.isfinite(value).all() for value in (wire, frame, imaged))
        if not finite or (wire.shape, frame.shape, imaged.shape) != ((3, 3), (4, 4), (5,)):
            raise UnusableInputError("a simulated wire is three finite points, a pose and five joints")
        return SimulatedWire(wire, RigidTransform.from_matrix(frame), imaged)
