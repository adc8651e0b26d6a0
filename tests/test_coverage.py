"""The locational cost and its gradient against loops, autograd, finite differences, closed forms and fine grids."""

import math

import numpy as np
import pytest
import torch

from envs import SurveillanceConfig
from envs.coverage import coverage_cost, coverage_gradient, quadrature_points, squared_distances, voronoi_moments
from envs.density import Density

SQUARE = [[-1.0, 1.0], [-1.0, 1.0]]
BOX = [[-1.0, 0.5], [0.0, 2.0], [0.2, 1.0]]


def problem(d, batch=3, n=4, resolution=7, seed=0):
    """Random positions in a box with random weights, one row of weights per world, float64."""
    rng = np.random.default_rng(seed)
    bounds = (BOX if d == 3 else [[-1.0, 0.5], [0.0, 2.0]])[:d]
    points, moment = quadrature_points(bounds, resolution, dtype=torch.float64)
    low, high = np.array(bounds).T
    position = torch.tensor(rng.uniform(low, high, (batch, n, d)))
    weights = torch.tensor(rng.uniform(0, 1, (batch, len(points))))
    return position, points, weights / weights.sum(-1, keepdim=True), moment


def loop_cost(position, points, weights):
    return [
        sum(w * min(math.dist(p, q) ** 2 for p in robots) for q, w in zip(points, row, strict=True))
        for robots, row in zip(position.tolist(), weights.tolist(), strict=True)
    ]


@pytest.mark.parametrize("d", [2, 3])
def test_points_are_the_cell_centres(d):
    bounds = BOX[:d]
    points, moment = quadrature_points(bounds, 4, dtype=torch.float64)
    centres = [[low + (high - low) * (2 * k + 1) / 8 for k in range(4)] for low, high in bounds]
    expected = np.stack(np.meshgrid(*centres, indexing="ij"), -1).reshape(-1, d)
    np.testing.assert_allclose(points.numpy(), expected, atol=1e-14)
    sides = [(high - low) / 4 for low, high in bounds]
    assert moment == pytest.approx(sum(side**2 for side in sides) / 12, abs=1e-15)


@pytest.mark.parametrize("d", [2, 3])
def test_squared_distances_match_loops_in_both_precisions(d):
    position, points, _, _ = problem(d)
    expected = [[[math.dist(p, q) ** 2 for q in points.tolist()] for p in robots] for robots in position.tolist()]
    np.testing.assert_allclose(squared_distances(position, points).numpy(), expected, atol=1e-13)
    single = squared_distances(position.float(), points.float())
    np.testing.assert_allclose(single.numpy(), expected, atol=1e-5)
    assert (squared_distances(points.float(), points.float()) >= 0).all()


@pytest.mark.parametrize("offset", [100.0, 1000.0])
def test_an_arena_far_from_the_origin_loses_no_digits_in_single_precision(offset):
    position, points, weights, _ = problem(2)
    near, far = ((position + c).float() for c in (0.0, offset))
    spread = 4 * offset * 2**-24 * 3  # what the coordinates themselves lose, at distances up to 3 m
    costs = [coverage_cost(p, (points + c).float(), weights.float(), 0.0) for p, c in ((near, 0.0), (far, offset))]
    assert (costs[0] - costs[1]).abs().max() < spread


@pytest.mark.parametrize("d", [2, 3])
def test_cost_matches_brute_force(d):
    position, points, weights, moment = problem(d)
    got = coverage_cost(position, points, weights, moment)
    np.testing.assert_allclose(
        got.numpy(), np.array(loop_cost(position, points.tolist(), weights)) + moment, atol=1e-13
    )
    shared = coverage_cost(position, points, weights[0], moment)  # one density for all worlds
    assert float(shared[0]) == pytest.approx(float(got[0]), abs=1e-14)
    assert float(shared[1]) != pytest.approx(float(got[1]), abs=1e-6)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("resolution", [2, 5, 20])
def test_one_robot_has_the_closed_form_wherever_it_is(d, resolution):
    bounds = BOX[:d]
    points, moment = quadrature_points(bounds, resolution, dtype=torch.float64)
    uniform = torch.full((len(points),), 1 / len(points), dtype=torch.float64)
    middle = torch.tensor([[(low + high) / 2 for low, high in bounds]], dtype=torch.float64)
    spread = sum((high - low) ** 2 for low, high in bounds) / 12
    assert float(coverage_cost(middle, points, uniform, moment)) == pytest.approx(spread, abs=1e-12)
    shift = torch.tensor([[0.3, -0.2, 0.1][:d]], dtype=torch.float64)
    shifted = float(coverage_cost(middle + shift, points, uniform, moment))
    assert shifted == pytest.approx(spread + float(shift.square().sum()), abs=1e-12)  # parallel axes


@pytest.mark.parametrize("d", [2, 3])
def test_gradient_is_that_of_the_cost(d):
    position, points, weights, moment = problem(d, seed=3)
    leaf = position.clone().requires_grad_()
    (autograd,) = torch.autograd.grad(coverage_cost(leaf, points, weights, moment).sum(), leaf)
    got = coverage_gradient(position, points, weights)
    assert got.abs().max() > 1e-2
    np.testing.assert_allclose(got.numpy(), autograd.numpy(), atol=1e-12)
    h = 1e-6
    for index in np.ndindex(*position.shape[1:]):
        shift = torch.zeros_like(position[0])
        shift[index] = h
        up, down = (coverage_cost(position + s * shift, points, weights, moment) for s in (1, -1))
        np.testing.assert_allclose(((up - down) / (2 * h)).numpy(), got[(slice(None), *index)].numpy(), atol=1e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_moments_match_loops_and_share_out_the_whole_mass(d):
    position, points, weights, _ = problem(d, seed=5)
    mass, centroid = voronoi_moments(position, points, weights)
    np.testing.assert_allclose(mass.sum(-1).numpy(), 1.0, atol=1e-13)
    for b, robots in enumerate(position.tolist()):
        owner = [min(range(len(robots)), key=lambda i, q=q, r=robots: math.dist(r[i], q)) for q in points.tolist()]
        for i in range(len(robots)):
            mine = [k for k, o in enumerate(owner) if o == i]
            expected = float(weights[b, mine].sum())
            assert float(mass[b, i]) == pytest.approx(expected, abs=1e-13)
            mean = (weights[b, mine, None] * points[mine]).sum(0) / expected
            np.testing.assert_allclose(centroid[b, i].numpy(), mean.numpy(), atol=1e-12)
    total = (mass.unsqueeze(-1) * centroid).sum(-2)
    np.testing.assert_allclose(total.numpy(), (weights @ points).numpy(), atol=1e-13)


def test_cell_without_mass_has_its_centroid_in_the_robot_and_no_gradient():
    points, _ = quadrature_points(SQUARE, 6, dtype=torch.float64)
    uniform = torch.full((36,), 1 / 36, dtype=torch.float64)
    position = torch.tensor([[0.0, 0.0], [9.0, 9.0]], dtype=torch.float64)
    mass, centroid = voronoi_moments(position, points, uniform)
    assert float(mass[1]) == 0
    assert torch.equal(centroid[1], position[1])
    assert torch.equal(coverage_gradient(position, points, uniform)[1], torch.zeros(2, dtype=torch.float64))


def fine_cost(config, position, resolution):
    """Independent J in numpy on a fine midpoint grid with the density's formula written out."""
    axes = [low + (high - low) * (np.arange(resolution) + 0.5) / resolution for low, high in config.bounds]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, config.dimension)
    phi = np.ones(len(grid))
    if config.density == "gaussian_mixture":
        centres = np.array(config.density_center_positions)
        phi = sum(np.exp(-((grid - c) ** 2).sum(1) / (2 * config.density_sigma**2)) for c in centres)
    phi = phi / phi.sum()
    nearest = np.full((len(position), len(grid)), np.inf)
    for robot in position.transpose(1, 0, 2):
        np.minimum(nearest, ((robot[:, None] - grid) ** 2).sum(-1), out=nearest)
    return nearest @ phi


def relative_rms(config, n, draws, fine):
    rng = np.random.default_rng(n)
    low, high = np.array(config.bounds).T
    position = rng.uniform(low, high, (draws, n, config.dimension))
    density = Density(config)
    assert len(density.points) == (20**2 if config.dimension == 2 else 10**3)
    weights = density.weights(torch.zeros(1, density.n_params)).reshape(-1)
    got = coverage_cost(torch.tensor(position, dtype=torch.float32), density.points, weights, density.cell_moment)
    exact = fine_cost(config, position, fine)
    return np.sqrt((((got.double().numpy() - exact) / exact) ** 2).mean())


@pytest.mark.parametrize("n", [1, 3, 8])
@pytest.mark.parametrize("density", ["uniform", "gaussian_mixture"])
def test_default_quadrature_is_within_one_percent_of_256_squared(density, n):
    assert relative_rms(SurveillanceConfig(n_agents=n, density=density), n, draws=50, fine=256) <= 0.01


@pytest.mark.parametrize("density", ["uniform", "gaussian_mixture"])
def test_default_quadrature_is_within_one_percent_in_a_long_arena(density):
    config = SurveillanceConfig(
        arena=[[0.0, 3.2], [0.0, 2.0]], density=density, density_centers=[[0.8, 0.6], [2.5, 1.5]]
    )
    assert relative_rms(config, 3, draws=50, fine=256) <= 0.01


@pytest.mark.parametrize("density", ["uniform", "gaussian_mixture"])
def test_default_quadrature_is_within_one_percent_in_three_dimensions(density):
    config = SurveillanceConfig(n_agents=4, dimension=3, arena=[*SQUARE, [0.0, 1.0]], density=density)
    assert relative_rms(config, 4, draws=20, fine=50) <= 0.01
