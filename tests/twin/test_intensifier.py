"""The distortion: exact both ways, as large as stated, and with the prior it states."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.errors import OutsideRegionError, SetUpError
from sightline.twin import draw_setup
from sightline.twin.xray.distributions import Distortion
from sightline.twin.xray.intensifier import Intensifier, RandomField, disc_mm, monomials
from sightline.twin.xray.presets import preset
from sightline.twin.xray.tubes import draw_earth, draw_tube, share_beyond_degree5

CHAIN = preset("9in-1k")
PA_AXES = np.eye(3)
LATERAL_AXES = np.array([[0, 0, -1.0], [0, 1.0, 0], [1.0, 0, 0]])


def intensifier(seed: int, axes: np.ndarray = PA_AXES, spread: Distortion | None = None) -> Intensifier:
    rng, spread = np.random.default_rng(seed), spread or Distortion()
    return draw_tube(rng, CHAIN, spread).expose(rng, axes, draw_earth(rng, spread))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), radius=st.floats(0, 505), angle=st.floats(0, 6.28))
def test_pixels_go_to_the_input_plane_and_back(seed, radius, angle):
    tube = intensifier(seed)
    uv = tube.centre_px + radius * np.array([np.cos(angle), np.sin(angle)])
    assert np.abs(tube.to_image(tube.to_detector(uv)) - uv).max() < 1e-8


def test_jacobian_and_derivatives_are_those_of_the_map():
    tube = intensifier(1)
    xi, step = disc_mm(118.0, 9), 1e-4
    numeric = [(tube.to_image(xi + step * e) - tube.to_image(xi - step * e)) / (2 * step) for e in np.eye(2)]
    assert np.allclose(tube.jacobian(xi), np.stack(numeric, -1), atol=1e-6)
    one = tube.distortion
    by = one.derivatives(xi)
    for k, bigger in (
        (0, replace(one, k1=one.k1 + 1e-9)),
        (2, replace(one, turn=one.turn + np.array([0, 1e-6, 0]))),
        (4, replace(one, shift_mm=one.shift_mm + 1e-3 * np.eye(2, 3))),
        (11, replace(one, cubic_mm=one.cubic_mm + 1e-3 * np.eye(7, 2, k=1))),
    ):
        change = bigger.parameters - one.parameters
        assert change[k] != 0
        assert np.allclose(bigger.apply(xi) - one.apply(xi), by @ change, atol=2e-6)


def test_the_random_field_has_the_covariance_stated():
    field = RandomField.over(107.5, 40.0)
    xi = disc_mm(107.5, 9)
    b = field.values(xi)
    d2 = ((xi[:, None] - xi) ** 2).sum(-1)
    assert np.abs(b @ b.T - np.exp(-d2 / (2 * 40.0**2))).max() < 2e-3


def test_what_is_left_after_a_fit_is_near_a_real_tube():
    """A real 310 mm tube leaves 0.32-0.43 mm after degree 3 and 0.11-0.13 after degree 5, of which 0.09 is the floor of
    its measurement: 0.31-0.42 and 0.06-0.09 without it. The twin's field is smaller."""
    left = {3: [], 5: []}
    for seed in range(40):
        tube = intensifier(seed, PA_AXES if seed % 2 else LATERAL_AXES)
        px = disc_mm(500.0, 31)
        xi = tube.to_detector(tube.centre_px + px)
        for degree, values in left.items():
            q = np.linalg.qr(monomials(px / 500.0, degree))[0]
            values.append(np.sqrt(((xi - q @ (q.T @ xi)) ** 2).sum(-1).mean()))
    assert 0.18 < np.median(left[3]) < 0.42
    assert 0.05 < np.median(left[5]) < 0.10


def test_amplitude_is_set_by_what_degree_5_leaves():
    share = share_beyond_degree5(107.5, 47.3, (30.0, 60.0))
    field = RandomField.over(107.5, 47.3)
    xi = disc_mm(107.5, 31)
    drawn = field.values(xi) @ np.random.default_rng(3).standard_normal((len(field), 400))
    q = np.linalg.qr(monomials(xi / 107.5, 5))[0]
    rms = np.sqrt(((drawn - q @ (q.T @ drawn)) ** 2).mean())
    assert rms == pytest.approx(share, rel=0.05)


def test_lateral_and_pa_centres_differ_as_in_the_paper():
    """Fig. 13: the central hole moved by 2-3 mm between the views."""
    still = replace(Distortion(), stray_ut=0.0, gradient_ut_per_mm=0.0)
    shifts = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        tube, earth = draw_tube(rng, CHAIN, still), draw_earth(rng, still)
        pa, lateral = (tube.expose(rng, axes, earth).distortion.shift_mm[:, 0] for axes in (PA_AXES, LATERAL_AXES))
        shifts.append(np.linalg.norm(pa - lateral))
    assert 2.0 < np.median(shifts) < 3.0


def test_the_prior_states_what_is_drawn():
    """Moments of 700 drawn sets of magnetic numbers, pincushions and cubics against the prior's covariance."""
    spread = Distortion()
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rng = np.random.default_rng(12)
    drawn = []
    for _ in range(700):
        one = draw_tube(rng, CHAIN, spread).expose(rng, axes, draw_earth(rng, spread))
        drawn.append(one.distortion.parameters[:24])
    factor = one.prior.smooth_factor
    stated = factor @ factor.T
    scale = np.sqrt(np.diag(stated))
    sampled = np.cov(np.array(drawn).T)
    # s.d. of a sampled correlation is about 0.04 (1 / sqrt(700)), more for the turn with its heavier tails
    assert np.abs((sampled - stated) / np.outer(scale, scale)).max() < 0.2


def test_beyond_cubic_covariance_is_that_of_drawn_maps():
    """Maps drawn from the stated prior around one map, less their cubic, scatter as stated. Amplitudes small, so that
    linearising costs nothing."""
    centre = intensifier(21)
    small = 0.02
    rng = np.random.default_rng(22)
    uv = centre.centre_px + disc_mm(480.0, 5)
    dense = disc_mm(CHAIN.mask_px, 21)
    powers, at = monomials(dense / CHAIN.mask_px, 3), monomials((uv - centre.centre_px) / CHAIN.mask_px, 3)
    both = np.concatenate([centre.centre_px + dense, uv])
    truth = centre.to_detector(both)
    jacobian = centre.jacobian(truth[len(dense) :])
    samples = []
    for _ in range(160):
        one = _redrawn(centre, rng, small)
        move = one.to_detector(both) - truth
        left = move[len(dense) :] - at @ np.linalg.lstsq(powers, move[: len(dense)])[0]
        samples.append(-(jacobian @ left[..., None]).ravel() / small)
    stated = centre.beyond_cubic_covariance(uv)
    scale = np.sqrt(np.diag(stated))
    samples = np.array(samples)
    sampled = samples.T @ samples / len(samples)
    assert np.abs((sampled - stated) / np.outer(scale, scale)).max() < 0.4  # 3.5 s.d. of a variance of 160
    # The same over all directions at once: s.d. 0.02.
    whitened = np.linalg.pinv(stated, rcond=1e-6) @ sampled
    rank = np.linalg.matrix_rank(stated, rtol=1e-6)
    assert np.trace(whitened) / rank == pytest.approx(1.0, abs=0.05)


def _redrawn(centre: Intensifier, rng: np.random.Generator, scale: float) -> Intensifier:
    one, n = centre.distortion, len(centre.distortion.parameters)
    change = scale * centre.prior.spread(np.eye(n)) @ rng.standard_normal(n)
    return Intensifier(
        centre.chain,
        replace(
            one,
            k1=one.k1 + change[0],
            turn=one.turn + change[1:4],
            shift_mm=one.shift_mm + change[4:10].reshape(2, 3),
            cubic_mm=one.cubic_mm + change[10:24].reshape(7, 2),
            random_mm=one.random_mm + change[24:].reshape(-1, 2),
        ),
        centre.prior,
    )


def test_a_cubic_is_no_part_of_what_is_beyond_it(frame):
    view = draw_setup(np.random.default_rng(13), frame).views["pa"].intensifier
    uv = view.centre_px + disc_mm(CHAIN.mask_px, 31)
    xi = view.to_detector(uv)
    moves = np.linalg.solve(view.jacobian(xi), view.beyond_cubic_factor(uv).reshape(len(uv), 2, -1))
    powers = monomials((uv - view.centre_px) / CHAIN.mask_px, 3)
    overlap = np.einsum("nk,ncp->kcp", powers, moves) / len(uv)
    assert np.abs(overlap).max() < 1e-9


def test_bad_input():
    tube = intensifier(2)
    with pytest.raises(OutsideRegionError):
        tube.to_detector(np.array([[np.nan, 5.0]]))
    with pytest.raises(SetUpError, match="folds"):
        intensifier(2, spread=replace(Distortion(), asymmetric_mm=80.0))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_nothing_from_far_outside_is_seen_in_the_field(seed):
    tube = intensifier(seed, LATERAL_AXES)
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for radius in (1.15, 1.5, 3.0, 20.0):
        assert not tube.in_field(tube.to_image(radius * 107.5 * ring)).any()
