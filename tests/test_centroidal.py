"""The lower bound of coverage against configurations known in closed form, and against every controller."""

import pytest
import torch

from agents import make_controller
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.centroidal import centroidal_cost
from envs.coverage import coverage_cost
from envs.density import Density

torch.set_num_threads(1)


@pytest.mark.parametrize(
    ("n", "cost"),
    [
        (1, 2 / 3),  # in the middle of the square of side 2
        (2, 1 / 12 + 1 / 3),  # two halves
        (4, 2 / 12),  # four quarters
    ],
)
def test_uniform_density(n, cost):
    assert centroidal_cost(SurveillanceConfig(n_agents=n, density="uniform")) == pytest.approx(cost, rel=1e-3)


@pytest.mark.parametrize("fields", [{}, {"density_per_world": True}, {"density": "moving"}, {"dimension": 3}])
def test_no_positions_are_better(fields):
    config = SurveillanceConfig(**fields)
    bound, density = centroidal_cost(config, densities=4), Density(config)
    generator = torch.Generator().manual_seed(0)
    weights = density.weights(density.sample(4 if density.n_params else 1, generator))
    low, high = density.bounds.unbind(-1)
    random = low + (high - low) * torch.rand(200, 1, 3, config.dimension, generator=generator)
    costs = coverage_cost(
        random.expand(200, len(weights.reshape(-1, len(density.points))), 3, -1),
        density.points,
        weights,
        density.cell_moment,
    )
    assert bound < costs.amin(0).mean()
    assert bound > 0.5 * costs.amin(0).mean()  # and not absurdly low


def test_lloyd_with_an_endless_battery_comes_near():
    config = SurveillanceConfig(drain_rate=1e-4, horizon=0)
    env, lloyd = SurveillanceEnv(config, 16, seed=0), make_controller("lloyd", config)
    td = env.reset()
    for _ in range(150):
        td = lloyd(td)
        td.set(keys.ACTION, td[keys.NOMINAL_ACTION])
        td = env.step(td)["next"]
    bound = centroidal_cost(config)
    best = td[keys.COVERAGE_COST].min().item()
    assert bound <= best * (1 + 1e-4)
    assert best == pytest.approx(bound, rel=0.02)


def test_age_has_none():
    assert centroidal_cost(SurveillanceConfig(density="age")) is None
