"""Image chains the twin can stand for. A further C-arm is a further entry of PRESETS."""

from dataclasses import dataclass

from sightline.errors import UnusableInputError


@dataclass(frozen=True)
class ImageChain:
    """A C-arm with an image intensifier: geometry, blur, dose response. Lengths at the input plane, mm.

    `field_mm`: diameter of the useful field; `shape` (H, W) px; `mask_px`: radius of the round blanking in the image.
    `core_mm`: standard deviation of the Gaussian core of the detector blur; `glare`, `glare_mm`: share and reach of
    the veiling glare (1 - g) delta + g exp(-r/k)/r. `white`: largest stored value. `dqe`: quanta counted per photon.
    """

    name: str
    sdd_mm: float
    field_mm: float
    shape: tuple[int, int]
    mask_px: float
    focal_spot_mm: float
    core_mm: float
    glare: float
    glare_mm: float
    scatter_to_primary: float
    dqe: float
    white: int

    @property
    def pitch_mm(self) -> float:
        """Input-plane millimetres per pixel, in the mean over the field: the field fills the image."""
        return self.field_mm / self.shape[0]


PRESETS = {
    "9in-1k": ImageChain(
        name="9in-1k",
        sdd_mm=1000.0,  # [src ARCADIS Varic manual]
        field_mm=215.0,  # [mem] useful field of a 9 in tube
        shape=(1024, 1024),  # 0.21 mm/px [mem]
        mask_px=506.0,  # [ours] 6 px inside the rim
        focal_spot_mm=0.6,  # [mem]
        core_mm=0.22,  # [calc] from the MTF of 25 tubes, Phys Med Biol 33:1 1988
        glare=0.15,  # [mem]
        glare_mm=20.0,  # [mem]
        scatter_to_primary=0.6,  # [mem] 0.4-0.8 with a grid
        dqe=0.65,  # [mem]
        white=4095,  # 12 bit
    )
}


def preset(name: str) -> ImageChain:
    """The image chain called `name`. Raises UnusableInputError, naming those there are."""
    if name not in PRESETS:
        raise UnusableInputError(f"there is no image chain {name!r}; there are: {', '.join(PRESETS)}")
    return PRESETS[name]
