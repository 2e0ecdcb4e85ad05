"""True poses of wire and frame, which a simulator sends to simulated imaging devices and no real robot knows."""

from dataclasses import dataclass
from json import JSONDecodeError, dumps, loads

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError


@dataclass(frozen=True, eq=False)
class SimulatedWire:
    """`wire_mm` (3, 3) MCS: current points of the wire's axis at the guide's mouth, at the bone (else halfway), and at
    the tip. `T_mcs_cfcs`: true pose of the frame at the images; `imaged` (5,): the encoders then."""

    wire_mm: np.ndarray
    T_mcs_cfcs: RigidTransform
    imaged: np.ndarray

    @property
    def axis_mm(self) -> np.ndarray:
        """(2, 3): where the wire leaves its guide, and its tip, CFCS of the images, mm."""
        return self.T_mcs_cfcs.inv().apply(self.wire_mm[[0, 2]])

    def text(self) -> str:
        """Return the text that the link carries."""
        values = {"wire_mm": self.wire_mm, "T_mcs_cfcs": self.T_mcs_cfcs.as_matrix(), "imaged": self.imaged}
        return dumps({name: value.tolist() for name, value in values.items()})

    @staticmethod
    def of(text: str) -> "SimulatedWire":
        """Return the wire from such a text. Raises UnusableInputError."""
        try:
            values_by_name = loads(text)
            names = ("wire_mm", "T_mcs_cfcs", "imaged")
            wire, frame, imaged = (np.array(values_by_name[name], dtype=np.float64) for name in names)
        except (JSONDecodeError, KeyError, TypeError, ValueError) as error:
            raise UnusableInputError("this text does not describe a simulated wire") from error
        finite = all(np.isfinite(value).all() for value in (wire, frame, imaged))
        if not finite or (wire.shape, frame.shape, imaged.shape) != ((3, 3), (4, 4), (5,)):
            raise UnusableInputError("a simulated wire is three finite points, a pose and five joints")
        return SimulatedWire(wire, RigidTransform.from_matrix(frame), imaged)
