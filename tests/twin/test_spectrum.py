"""Tungsten spectra: a table that agrees with the older one, harder by filter and by matter, and in the images."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.imaging.volumes.beam import TABLE_KEV, TABLE_PER_CM, THREE, attenuation_per_mm, spectrum
from sightline.twin import Scene, draw_setup
from sightline.twin.objects.things import Ball, pack
from sightline.twin.xray.presets import PRESETS
from sightline.twin.xray.render import expose

TUNGSTEN = ("70kVp-3Al", "70kVp-3Al-0.1Cu")


@pytest.mark.parametrize("name", TUNGSTEN)
def test_a_spectrum_is_whole_and_ends_at_its_voltage(name):
    beam = spectrum(name)
    assert beam.weights.sum() == pytest.approx(1.0, abs=1e-4)
    assert (np.diff(beam.energies_kev) > 0).all()
    assert beam.energies_kev[-1] < 70.0
    assert beam.per_mm.keys() == TABLE_PER_CM.keys()


@pytest.mark.parametrize("material", TABLE_PER_CM)
def test_attenuation_agrees_with_the_table_of_three_energies(material):
    """Between 40 and 70 keV, straight in log-log between the table's entries: a curve lies up to 3 % below."""
    beam = spectrum("70kVp-3Al")
    kev = beam.energies_kev
    within = kev > 40.0
    straight = np.exp(np.interp(np.log(kev), np.log(TABLE_KEV), np.log(TABLE_PER_CM[material]))) / 10
    assert beam.per_mm[material][within] == pytest.approx(straight[within], rel=0.06)
    assert (np.diff(beam.per_mm[material]) < 0).all()


def mean_kev(name: str, tissue_mm: float) -> float:
    left = spectrum(name).weights * np.exp(-tissue_mm * attenuation_per_mm("tissue", name))
    return float(left @ spectrum(name).energies_kev / left.sum())


def test_filter_and_body_harden_a_beam():
    soft, copper = TUNGSTEN
    assert mean_kev(soft, 0.0) == pytest.approx(40.3, abs=0.2)  # spekpy, before bins were made
    assert mean_kev(copper, 0.0) > mean_kev(soft, 0.0) + 2.0
    assert mean_kev(soft, 200.0) > mean_kev(soft, 0.0) + 5.0


def test_images_are_cast_with_the_spectrum_of_their_chain(frame):
    """Middle of a ball in PMMA, before scatter and blur: what each energy leaves, by its share."""
    view = draw_setup(np.random.default_rng(51), frame, chain="9in-pal").views["pa"]
    tube = view.intensifier
    for name in (THREE, *TUNGSTEN):
        chain = replace(tube.chain, scatter_to_primary=0.0, spectrum=name)
        seen = replace(view, intensifier=type(tube)(chain, tube.distortion, tube.prior))
        exposure = expose(seen, Scene(solids=(Ball((0.0, 0.0, 150.0), 6.0),)))
        u, v = np.rint(view.project(np.array([0.0, 0.0, 150.0]))).astype(int)
        excess = attenuation_per_mm("steel", name) - attenuation_per_mm("pmma", name)
        expected = float(spectrum(name).weights @ np.exp(-12.0 * excess))
        assert exposure.quanta[v, u] / exposure.open_quanta[v, u] == pytest.approx(expected, rel=0.05)


def test_a_preset_names_a_spectrum_there_is():
    for chain in PRESETS.values():
        _, excess = pack([Ball((0.0, 0.0, 0.0), 1.5)], chain.spectrum)
        assert excess.shape == (1, len(spectrum(chain.spectrum).weights))
    assert PRESETS["9in-1k"].spectrum == THREE


def test_bad_input():
    with pytest.raises(UnusableInputError, match="70kVp-3Al"):
        spectrum("60kVp")
    with pytest.raises(UnusableInputError, match="steel"):
        attenuation_per_mm("cheese", "70kVp-3Al")
