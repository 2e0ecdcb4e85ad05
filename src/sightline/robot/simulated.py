"""What a simulator tells simulated imaging devices and no robot knows: where wire and frame truly are."""

from dataclasses import dataclass
from json import JSONDecodeError, dumps, loads

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError


@dataclass(frozen=True, eq=False)
class SimulatedWire:
    """`wire_mm` (3, 3) MCS: the wire's axis at its guide's mouth, where bone holds it (else halfway), and its tip, as
    they are now. `T_mcs_cfcs`: the frame as it stood when the images were taken."""

    wire_mm: np.ndarray
    T_mcs_cfcs: RigidTransform

    @property
    def axis_mm(self) -> np.ndarray:
        """(2, 3): where it leaves its guide and its tip, CFCS of the images."""
        return self.T_mcs_cfcs.inv().apply(self.wire_mm[[0, 2]])

    def text(self) -> str:
        """As the link carries it."""
        return dumps({"wire_mm": self.wire_mm.tolist(), "T_mcs_cfcs": self.T_mcs_cfcs.as_matrix().tolist()})

    @staticmethod
    def of(text: str) -> "SimulatedWire":
        """From such a text. Raises UnusableInputError."""
        try:
            said = loads(text)
            wire, frame = (np.array(said[key], dtype=np.float64) for key in ("wire_mm", "T_mcs_cfcs"))
        except (JSONDecodeError, KeyError, TypeError, ValueError) as error:
            raise UnusableInputError("this text does not say where a simulated wire is") from error
        if wire.shape != (3, 3) or frame.shape != (4, 4) or not (np.isfinite(wire).all() and np.isfinite(frame).all()):
            raise UnusableInputError("a simulated wire is three finite points and a pose")
        return SimulatedWire(wire, RigidTransform.from_matrix(frame))
