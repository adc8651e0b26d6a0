"""Coverage with unlimited batteries: an estimate of the centroidal Voronoi cost, below which no policy stays for long."""

import torch

from envs.config import SurveillanceConfig
from envs.coverage import coverage_cost, voronoi_moments
from envs.density import Density

STARTS, SWEEPS = 16, 100  # descents per density, and their length


def centroidal_cost(config: SurveillanceConfig, densities: int = 256, seed: int = 0) -> float | None:
    """Least coverage cost of robots that never charge and may stand anywhere, mean over the world's densities.

    The best of several descents of Lloyd's algorithm from random positions: an estimate from above of the minimum of a
    function that is not convex. A moving density counts as drawn, at one instant.

    Args:
        config: the world.
        densities: densities drawn where they vary; the standard error of 256 is 0.8 % with env=random_density.
        seed: of densities and positions.

    Returns:
        J, m^2; None for ``density=age``, whose importance follows the robots.
    """
    if config.density == "age":
        return None
    density = Density(config)
    generator = torch.Generator().manual_seed(seed)
    weights = density.weights(density.sample(densities if density.n_params else 1, generator))
    weights = weights.expand(densities if density.n_params else 1, -1)
    low, high = density.bounds.unbind(-1)
    shape = (STARTS, len(weights), config.n_agents, config.dimension)
    position = low + (high - low) * torch.rand(shape, generator=generator, dtype=low.dtype)
    for _ in range(SWEEPS):
        _, position = voronoi_moments(position, density.points, weights)
    cost = coverage_cost(position, density.points, weights, density.cell_moment)
    return float(cost.amin(dim=0).mean())
