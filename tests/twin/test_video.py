"""The video chain, measured back from its images: fields, line jitter, gain, digitisation."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import SetUpError
from sightline.twin.xray.presets import Video, preset
from sightline.twin.xray.render import Exposure

PAL = preset("9in-pal")
VIDEO = PAL.video or Video()
PERIOD_PX = 24.0
INNER = slice(24, -24)


def waves(
    u_px: float = 0.0, *, along: int = 1, video: Video = VIDEO, white: int = 4095, quanta: float = 1e7
) -> Exposure:
    """A wave across the image, along u (1) or v (0), moved by `u_px`, of so many quanta that their noise is nothing."""
    h, w = PAL.shape
    at = np.mgrid[:h, :w][along] - u_px
    light = quanta * (1 + 0.5 * np.sin(2 * np.pi * at / PERIOD_PX))
    chain = replace(PAL, glare=0.0, white=white, video=video)
    return Exposure(chain, light, light, np.ones((h, w), dtype=bool), 0.6, 0.5 * white / quanta)


def places(image: np.ndarray) -> np.ndarray:
    """(lines,) px: how far the wave along each line of an image has moved."""
    lines = image[:, INNER].astype(float)
    u = np.arange(image.shape[1])[INNER]
    phase = np.angle((lines - lines.mean(axis=1, keepdims=True)) @ np.exp(-2j * np.pi * u / PERIOD_PX)) + np.pi / 2
    return -(np.angle(np.exp(1j * phase))) * PERIOD_PX / (2 * np.pi)


def test_each_line_starts_where_its_sync_was_found():
    moved = places(waves().read_out(np.random.default_rng(1)).pixels)[INNER]
    assert moved.std() == pytest.approx(0.1, rel=0.1)  # 576 lines: s.d. of the estimate 3 %
    assert abs(np.corrcoef(moved[1:], moved[:-1])[0, 1]) < 0.15
    steady = places(waves(video=replace(VIDEO, jitter_px=0.0)).read_out(np.random.default_rng(1)).pixels)[INNER]
    assert np.abs(steady).max() < 0.02


def test_at_rest_the_fields_differ_by_pairing_and_gain_alone():
    video = Video(jitter_px=0.0, pairing_px=0.23, field_gain=0.03)
    image = waves(along=0, video=video).read_out(np.random.default_rng(2)).pixels.astype(float)
    even, odd = image[INNER][0::2, INNER], image[INNER][1::2, INNER]
    black = 0.02 * 4095
    assert (odd - black).mean() / (even - black).mean() == pytest.approx(1.03, abs=1e-3)
    v = np.arange(PAL.shape[0])[INNER]
    phases = [
        np.angle((rows.mean(axis=1) - rows.mean()) @ np.exp(-2j * np.pi * v[start::2] / PERIOD_PX))
        for start, rows in ((0, even), (1, odd))
    ]
    assert (phases[1] - phases[0]) * PERIOD_PX / (2 * np.pi) == pytest.approx(0.23, abs=0.01)


def test_the_second_field_sees_what_has_moved_meanwhile():
    first, second = waves(), waves(1.37)
    moved = places(first.read_out(np.random.default_rng(3), second).pixels)
    assert moved[0::2].mean() == pytest.approx(0.0, abs=0.03)  # 288 lines of 0.1 px: 0.006
    assert moved[1::2].mean() == pytest.approx(1.37, abs=0.03)
    still = places(first.read_out(np.random.default_rng(3)).pixels)
    assert still[1::2].mean() - still[0::2].mean() == pytest.approx(0.0, abs=0.03)


def test_fields_are_exposed_one_by_one():
    """Quantum noise is correlated by the blur within a field only: between neighbouring lines there is none."""
    flat = waves(quanta=50.0)
    even = replace(flat, quanta=np.full(PAL.shape, 50.0))
    noise = even.read_out(np.random.default_rng(4)).pixels[INNER, INNER].astype(float)
    noise[0::2] -= noise[0::2].mean()
    noise[1::2] -= noise[1::2].mean()
    assert abs((noise[1:] * noise[:-1]).mean() / noise.var()) < 0.01
    assert (noise[:, 1:] * noise[:, :-1]).mean() / noise.var() > 0.3


@pytest.mark.parametrize("white", [255, 1023, 4095])
def test_values_are_whole_and_noise_is_video_and_rounding(white):
    one = replace(waves(white=white), quanta=np.full(PAL.shape, 1e7))
    image = one.read_out(np.random.default_rng(5))
    assert image.white == white
    assert image.pixels.max() <= white
    expected = (VIDEO.noise * white) ** 2 + 1 / 12
    assert image.pixels[INNER][0::2, INNER].var() == pytest.approx(expected, rel=0.05)


def test_a_chain_without_fields_has_no_second():
    whole = waves(video=VIDEO)
    whole = replace(whole, chain=replace(whole.chain, video=None))
    with pytest.raises(SetUpError, match="whole frames"):
        whole.read_out(np.random.default_rng(6), whole)


LAG = replace(VIDEO, jitter_px=0.0, pairing_px=0.0, field_gain=0.0, noise=0.0, lag=0.2)


def level(share: float) -> Exposure:
    """An even field, of a share of 1e7 quanta."""
    light = np.full(PAL.shape, 1e7 * share)
    chain = replace(PAL, glare=0.0, white=4095, video=LAG)
    return Exposure(chain, light, light, np.ones(PAL.shape, dtype=bool), 0.6, 0.5 * 4095 / 1e7)


def fields(image) -> np.ndarray:
    """(2,): what the fields show in the middle, over that of a share of 1, black taken off."""
    inner = image.pixels[INNER, INNER].astype(float) - 0.02 * 4095
    return np.array([inner[0::2].mean(), inner[1::2].mean()]) / (0.5 * 4095)


def test_a_flash_dies_away_exponentially():
    """A bright field k fields ago, darkness since: of it remain lag^k of what was shown, in each later field."""
    dark, flash = level(0.1), level(1.5)
    shown = {}
    for k in (1, 2, 4):
        former = [*[dark] * (k - 1), flash, dark]
        shown[k] = fields(dark.read_out(np.random.default_rng(3), former=former)) - 0.1
        expected = 1.4 * (1 - LAG.lag) * np.array([LAG.lag**k, LAG.lag ** (k + 1)])
        assert shown[k] == pytest.approx(expected, abs=2e-4)


def test_what_was_always_so_remains_so_and_rest_needs_no_former_fields():
    now = level(0.7)
    still = fields(now.read_out(np.random.default_rng(4), former=[now, now]))
    assert still == pytest.approx(fields(now.read_out(np.random.default_rng(4))), abs=2e-4)
    changed = fields(now.read_out(np.random.default_rng(4), former=[level(0.2)]))
    assert changed == pytest.approx([0.8 * 0.7 + 0.2 * 0.2, 0.96 * 0.7 + 0.04 * 0.2], abs=2e-4)


def test_the_second_field_trails_the_first():
    now, then = level(0.3), level(0.9)
    assert fields(now.read_out(np.random.default_rng(5), then, former=[now])) == pytest.approx(
        [0.3, 0.8 * 0.9 + 0.2 * 0.3], abs=2e-4
    )


def test_the_default_lag_is_small_and_whole_frames_have_none():
    assert VIDEO.lag == 0.01
    whole = replace(level(0.5), chain=preset("9in-1k"))
    with pytest.raises(SetUpError, match="no lag"):
        whole.read_out(np.random.default_rng(6), former=[whole])
