"""Density families: normalised, non-negative, per world, moving on their circles, ageing where nobody looks."""

import math

import numpy as np
import pytest
import torch

from envs import SurveillanceConfig
from envs.density import Density

FAMILIES = {
    "uniform": {"density": "uniform"},
    "fixed": {"density": "gaussian_mixture"},
    "drawn": {"density": "gaussian_mixture", "density_per_world": True},
    "moving": {"density": "moving"},
    "age": {"density": "age"},
}
ARENA = {2: [[-1.0, 2.0], [0.0, 2.0]], 3: [[-1.0, 2.0], [0.0, 2.0], [0.0, 1.0]]}


def make(family, d=2, **changes):
    return Density(SurveillanceConfig(dimension=d, arena=ARENA[d], dtype="float64", **FAMILIES[family], **changes))


def sample(density, batch=6, seed=0):
    return density.sample(batch, torch.Generator().manual_seed(seed))


def aged(density, batch=6, steps=5, seed=0):
    """Parameters after a few steps in which random points were seen."""
    generator = torch.Generator().manual_seed(seed)
    params = sample(density, batch, seed)
    for _ in range(steps):
        params = density.advance(
            params, torch.rand(batch, len(density.points), generator=generator, dtype=torch.float64)
        )
    return params


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_weights_are_non_negative_and_sum_to_one(family, d):
    density = make(family, d)
    for params in (sample(density), aged(density)):
        weights = density.weights(params)
        assert weights.shape[-1] == len(density.points)
        assert (weights >= 0).all()
        np.testing.assert_allclose(weights.sum(-1).numpy(), 1.0, atol=1e-12)


@pytest.mark.parametrize("family", ["uniform", "fixed"])
def test_constant_families_have_no_parameters(family):
    density = make(family)
    assert sample(density).shape == (6, 0)
    assert density.advance(sample(density), torch.ones(6, len(density.points))).shape == (6, 0)
    assert density.weights(sample(density)).shape == (len(density.points),)
    assert (density.n_params, density.n_observed) == (0, 0)


def test_uniform_weighs_every_point_alike():
    assert torch.equal(make("uniform").weights(torch.zeros(1, 0)), torch.full((400,), 1 / 400, dtype=torch.float64))


@pytest.mark.parametrize("d", [2, 3])
def test_mixture_follows_its_formula(d):
    density = make("fixed", d, density_centers=[[0.5, 0.5], [1.5, 1.0]], density_sigma=0.4)
    centres = [[0.5, 0.5, 0.5][:d], [1.5, 1.0, 0.5][:d]]  # the missing height is the middle of the arena
    phi = [sum(math.exp(-(math.dist(q, c) ** 2) / (2 * 0.4**2)) for c in centres) for q in density.points.tolist()]
    np.testing.assert_allclose(density.weights(torch.zeros(1, 0)).numpy(), np.array(phi) / sum(phi), atol=1e-14)


@pytest.mark.parametrize("changes", [{"density_sigma": 1e-3}, {"density_centers": [[90.0, -40.0]]}])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_components_that_underflow_everywhere_still_give_a_density(changes, dtype):
    config = SurveillanceConfig(density="gaussian_mixture", dtype=dtype, **changes)
    weights = Density(config).weights(torch.zeros(1, 0))
    assert weights.isfinite().all()
    assert float(weights.sum()) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("family", ["drawn", "moving"])
def test_worlds_draw_different_densities(family):
    density = make(family)
    weights = density.weights(sample(density))
    for a in range(6):
        for b in range(a):
            assert (weights[a] - weights[b]).abs().sum() > 1e-3
    assert torch.equal(sample(density, seed=3), sample(density, seed=3))
    assert not torch.equal(sample(density, seed=3), sample(density, seed=4))


@pytest.mark.parametrize("d", [2, 3])
def test_drawn_centres_fill_the_inner_arena(d):
    density = make("drawn", d)
    centres = density.component_centers(sample(density, 2000))
    assert centres.shape == (2000, 3, d)
    for axis, (low, high) in enumerate(ARENA[d]):
        values, margin = centres[..., axis], 0.1 * (high - low)
        assert low + margin <= values.min() < low + 1.2 * margin
        assert high - 1.2 * margin < values.max() <= high - margin
    weights = density.weights(sample(density, 2000)[:2])
    phi = [sum(math.exp(-(math.dist(q, c) ** 2) / 0.18) for c in centres[1].tolist()) for q in density.points.tolist()]
    np.testing.assert_allclose(weights[1].numpy(), np.array(phi) / sum(phi), atol=1e-13)


@pytest.mark.parametrize("d", [2, 3])
def test_moving_centres_go_round_their_circle_once_a_period(d):
    density = make("moving", d, density_amplitude=0.25, density_period=8.0, dt=0.2)
    middle = density.centers
    start = sample(density)
    params, places = start, []
    for _ in range(40):  # 40 steps of 0.2 s are one period of 8 s
        places.append(density.component_centers(params))
        params = density.advance(params, torch.ones(6, len(density.points)))
    np.testing.assert_allclose(
        density.component_centers(params).numpy(), density.component_centers(start).numpy(), atol=1e-12
    )
    track = torch.stack(places)  # (40, B, K, d)
    radius = (track - middle)[..., :2].norm(dim=-1)
    np.testing.assert_allclose(radius.numpy(), 0.25, atol=1e-12)
    chord = (track[1:] - track[:-1]).norm(dim=-1)
    np.testing.assert_allclose(chord.numpy(), 2 * 0.25 * math.sin(math.pi / 40), atol=1e-12)
    np.testing.assert_allclose(track.mean(0).numpy(), middle.expand(6, -1, -1).numpy(), atol=1e-12)
    if d == 3:
        assert torch.equal(track[..., 2], middle[:, 2].expand(40, 6, 3))


def test_age_is_zero_where_seen_grows_elsewhere_and_saturates():
    density = make("age", dt=0.5, max_speed=0.05, age_limit=2.0, sensing_radius=0.3)
    assert torch.equal(sample(density), torch.zeros(6, 400, dtype=torch.float64))
    squared = torch.full((1, 400), 0.0901, dtype=torch.float64)  # just out of sight
    squared[:, :7] = 0.0899  # just in sight
    params = sample(density, 1)
    seen, unseen = [], []
    for _ in range(6):
        params = density.advance(params, squared)
        seen.append(params[:, :7].abs().max().item())
        unseen.append((params[:, 7:].min().item(), params[:, 7:].max().item()))
    assert seen == [0.0] * 6
    assert unseen == [(t, t) for t in (0.5, 1.0, 1.5, 2.0, 2.0, 2.0)]
    again = density.advance(params, torch.flip(squared, dims=[1]))  # now others are seen
    assert again[0, -7:].tolist() == [0.0] * 7
    assert again[0, :7].tolist() == [0.5] * 7


def test_age_weighs_by_time_since_last_seen():
    density = make("age", dt=0.5, max_speed=0.05)
    params = aged(density, steps=9)
    weights = density.weights(params)
    expected = (params + 0.5) / (params + 0.5).sum(-1, keepdim=True)
    np.testing.assert_allclose(weights.numpy(), expected.numpy(), atol=1e-15)
    fresh = density.weights(sample(density))  # nobody has looked anywhere yet: all alike
    np.testing.assert_allclose(fresh.numpy(), 1 / 400, atol=1e-15)
    oldest, youngest = params[0].argmax(), params[0].argmin()
    assert weights[0, oldest] > 2 * weights[0, youngest]


@pytest.mark.parametrize(("d", "per_axis"), [(2, 20), (3, 12)])
def test_age_is_observed_as_block_means(d, per_axis):
    density = make("age", d, age_limit=4.0, resolution=per_axis)
    generator = torch.Generator().manual_seed(1)
    params = 4 * torch.rand(2, per_axis**d, generator=generator, dtype=torch.float64)
    block = per_axis // 4
    field = params.numpy().reshape(2, *[n for _ in range(d) for n in (4, block)])
    means = field.mean(axis=tuple(2 + 2 * k for k in range(d))) / 4.0
    got = density.observe(params)
    assert got.shape == (2, 4**d)
    np.testing.assert_allclose(np.sort(got.numpy(), -1), np.sort(means.reshape(2, -1), -1), atol=1e-12)


@pytest.mark.parametrize("resolution", [2, 3, 5])
def test_age_on_a_grid_coarser_than_the_observation_stays_finite(resolution):
    density = make("age", resolution=resolution)
    assert density.observe(aged(density)).isfinite().all()


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(
    ("family", "size"), [("uniform", 0), ("fixed", 0), ("drawn", "centres"), ("moving", "centres"), ("age", "cells")]
)
def test_observation_has_the_announced_size(family, size, d):
    density = make(family, d)
    expected = {0: 0, "centres": 3 * d, "cells": 4**d}[size]
    assert density.n_observed == expected
    observed = density.observe(sample(density))
    assert observed.shape == (6, expected)
    assert observed.abs().max() <= 1.5 if expected else True


@pytest.mark.parametrize("family", ["drawn", "moving"])
@pytest.mark.parametrize("d", [2, 3])
def test_centres_are_observed_relative_to_the_arena(family, d):
    density = make(family, d)
    params = sample(density)
    middle = np.array([(low + high) / 2 for low, high in ARENA[d]])
    expected = (density.component_centers(params).numpy() - middle) / 1.5  # half the longest side
    np.testing.assert_allclose(density.observe(params).numpy(), expected.reshape(6, -1), atol=1e-14)
