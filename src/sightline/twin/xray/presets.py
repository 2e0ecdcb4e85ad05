"""Image chains of the twin. To add a C-arm, add an entry to CHAINS."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.common.names import named
from sightline.frame.plate import FIELD_DIAMETER_MM
from sightline.imaging.volumes.beam import THREE


@dataclass(frozen=True)
class Video:
    """An interlaced video camera and its frame grabber.

    Even lines are the first field; odd lines are the second, `field_s` later. The second field is displaced downwards
    by `pairing_px` and brighter by the share `field_gain`. `jitter_px`: s.d. of the start of each line, from the
    grabber's synchronisation. `noise`: s.d. over the white level, before digitisation. `lag`: share of a field's light
    that remains in the next field; the square of it remains in the one after, and so on. Values [ours, typical].
    """

    field_s: float = 0.020  # 50 fields a second [src ITU-R BT.1700]
    pairing_px: float = 0.1  # a tenth of a line
    field_gain: float = 0.01
    jitter_px: float = 0.1  # sync good to 5-10 ns, a pixel takes 68 ns
    noise: float = 0.004  # 48 dB
    lag: float = 0.01  # CCD and output phosphor: at most this after 20 ms; a vidicon has 0.2 or more


@dataclass(frozen=True)
class ImageChain:
    """A C-arm with its detector: geometry, blur, dose response. Lengths at the input plane, mm.

    - `field_mm`: diameter of the useful field, which fills the image's height; side of the image of a flat panel
    - `tube_mm`: diameter of the intensifier's own field, on which the distortion depends (a zoom shows its middle);
      None: a flat panel without distortion
    - `shape` (H, W) px
    - `mask_px`: radius of the round blanking in the image, 4 to 8 px inside the edge [ours]; half the width of the
      square collimation of a flat panel
    - `core_mm`: standard deviation of the Gaussian core of the detector blur
    - `glare`, `glare_mm`: share and reach of the veiling glare (1 - g) delta + g exp(-r/k)/r
    - `dqe`: quanta counted per photon
    - `white`: largest stored value
    - `video`: None for a camera that reads whole frames
    - `spectrum`: the beam before the patient (beam.py)
    """

    name: str
    sdd_mm: float
    field_mm: float
    tube_mm: float | None
    shape: tuple[int, int]
    mask_px: float
    focal_spot_mm: float
    core_mm: float
    glare: float
    glare_mm: float
    scatter_to_primary: float
    dqe: float
    white: int
    video: Video | None = None
    spectrum: str = THREE

    @property
    def pitch_mm(self) -> float:
        """Mean size of a pixel on the input plane, mm: the field fills the height of the image."""
        return self.field_mm / self.shape[0]

    @property
    def centre_px(self) -> np.ndarray:
        """The undistorted centre (2,) of the field."""
        h, w = self.shape
        return np.array([(w - 1) / 2, (h - 1) / 2])

    @property
    def reach_px(self) -> float:
        """The largest distance of the field's edge from its centre: to the corners of a flat panel."""
        return self.mask_px if self.tube_mm is not None else float(np.sqrt(2)) * self.mask_px

    def rim_px(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the distances (...,), px, of pixels (..., 2) from the edge of the field, negative outside."""
        off = np.asarray(uv_px) - self.centre_px
        if self.tube_mm is None:
            return self.mask_px - np.abs(off).max(axis=-1)
        return self.mask_px - np.linalg.norm(off, axis=-1)


FILTERED = "70kVp-3Al"  # [ours, typical]
NINE_INCH = ImageChain(
    name="9in-1k",
    sdd_mm=1000.0,  # [src ARCADIS Varic manual]
    field_mm=FIELD_DIAMETER_MM,
    tube_mm=FIELD_DIAMETER_MM,
    shape=(1024, 1024),  # 0.21 mm/px [ours, typical]
    mask_px=506.0,
    focal_spot_mm=0.6,  # [ours, typical]
    core_mm=0.22,  # [calc] from the MTF of 25 tubes, Phys Med Biol 33:1 1988
    glare=0.15,  # [ours, typical]
    glare_mm=20.0,  # [ours, typical]
    scatter_to_primary=0.6,  # [ours, typical] 0.4-0.8 with a grid
    dqe=0.65,  # [ours, typical]
    white=4095,  # 12 bit
)
FLAT_PANEL = replace(
    NINE_INCH,
    name="flat-panel",
    sdd_mm=1020.0,  # [src xreg, DeepDRR: CIOS Fusion]
    field_mm=298.0,  # 1536 x 0.194 mm [src xreg, DeepDRR]
    tube_mm=None,
    shape=(1536, 1536),
    mask_px=760.0,
    core_mm=0.17,  # [ours, typical] CsI of 0.5 mm: 55 % at 1/mm, the pixel's width included
    glare=0.0,  # only tubes have veiling glare
    glare_mm=0.0,
    dqe=0.70,  # [ours, typical] CsI
    white=65535,  # 16 bit
    spectrum="70kVp-3Al-0.1Cu",  # [ours, typical]
)
CHAINS = (
    NINE_INCH,
    replace(
        NINE_INCH,
        name="9in-pal",
        shape=(576, 768),  # frame grabber [ours, typical]; 0.37 mm/px, within what the paper's "2-3 mm = 8 px" gives
        mask_px=284.0,
        white=255,  # 8 bit
        video=Video(),
        spectrum=FILTERED,
    ),
    replace(
        NINE_INCH,
        name="17cm-1k",
        field_mm=160.0,  # [ours, typical] useful field of a 17 cm zoom, as 215 mm is of 23 cm
        core_mm=0.18,  # [ours] a zoom has a higher resolution
        spectrum=FILTERED,
    ),
    FLAT_PANEL,
    # Panels of 30 cm with pixels of a tenth of a millimetre, read singly or averaged 2 x 2 or 3 x 3 [ours, typical].
    *(
        replace(FLAT_PANEL, name=f"flat-panel-{pitch}", field_mm=300.0, shape=(side, side), mask_px=0.495 * side)
        for pitch, side in ((0.1, 3000), (0.2, 1500), (0.3, 1000))
    ),
)
PRESETS = {chain.name: chain for chain in CHAINS}


def preset(name: str) -> ImageChain:
    """Return the image chain called `name`. Raises UnusableInputError, which lists the valid names."""
    return named(name, PRESETS, "image chain")
