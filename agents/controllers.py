"""Nominal policies to compare with, by name. Each writes ("agents", "nominal_action")."""

from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agents.adversaries import ADVERSARIES, Random
from agents.base import Controller
from agents.learned import Learned
from agents.patrol import Patrol
from envs import SurveillanceConfig, keys
from envs.coverage import coverage_cost, coverage_gradient, voronoi_moments
from envs.dynamics import limit_speed
from safety import SafetyConfig, SafetyFilter


class Lloyd(Controller):
    """Drive to the centroid of the own Voronoi cell, as fast as one step allows. Knows nothing of batteries."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position = tensordict[keys.POSITION]
        density, weights = self.weights(tensordict)
        _, centroid = voronoi_moments(position, density.points, weights)
        return limit_speed((centroid - position) / self.world.dt, self.world.max_speed)


class ChargeWhenLow(Lloyd):
    """Lloyd until the energy nears the reserve, then home, and stay until nearly full.

    The hysteresis needs no memory: a robot inside its slot's charging radius that is not full stays.
    """

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        home, way_home = self.way_to_charge(tensordict)
        return torch.where(home.unsqueeze(-1), way_home, super().act(tensordict))


class CoverageCBF(Controller):
    """The literature's coverage controller: task barrier ``h_t = -J`` with slack.

    ``min sum ||u_i||^2 + kappa delta^2  s.t.  -grad J . u >= alpha J - delta``; as J > 0 the row is always active, so
    ``u = -kappa alpha J grad J / (1 + kappa ||grad J||^2)``, cut to the speed limit. Nominal for any filter.

    Source: the paper, section III.B; Notomista & Egerstedt, arXiv 1903.05810.
    """

    kappa = 1e3
    alpha = 1.0

    def gradient(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """``J (*B, 1, 1)`` and ``grad J (*B, N, d)``."""
        position = tensordict[keys.POSITION]
        density, weights = self.weights(tensordict)
        cost = coverage_cost(position, density.points, weights, density.cell_moment)
        return cost[..., None, None], coverage_gradient(position, density.points, weights)

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        cost, gradient = self.gradient(tensordict)
        squared = gradient.square().sum((-2, -1), keepdim=True)
        action = -self.kappa * self.alpha * cost * gradient / (1 + self.kappa * squared)
        return limit_speed(action, self.world.max_speed)


class CoverageCBFLiteral(CoverageCBF):
    """:class:`CoverageCBF` with the survivability and collision rows in the same joint quadratic program.

    Hessian ``I + kappa grad J grad J^T`` once the slack is eliminated. A problem without solution holds (u = 0).
    The accepted current is not a controller's to write: behind ``safety=none`` it is 1, so that the overcharge row is
    missing there; run it behind ``safety=paper`` for the literature's controller with its current.
    """

    def __init__(self, world: SurveillanceConfig, seed: int = 0) -> None:
        super().__init__(world, seed)
        self.rows = SafetyFilter(SafetyConfig(mode="paper", split="joint", sampled_data=False), world)

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        cost, gradient = self.gradient(tensordict)
        flat = gradient.flatten(-2)
        identity = torch.eye(flat.shape[-1], dtype=flat.dtype, device=flat.device)
        Q = identity + self.kappa * flat.unsqueeze(-1) * flat.unsqueeze(-2)
        p = self.kappa * self.alpha * cost.squeeze(-1) * flat
        position, energy, slot = (tensordict[key] for key in (keys.POSITION, keys.ENERGY, keys.SLOT))
        return self.rows.solve_task(Q, p, position, energy.squeeze(-1), slot.squeeze(-1))


CONTROLLERS: dict[str, type[Controller]] = {
    "random": Random,
    "lloyd": Lloyd,
    "charge_when_low": ChargeWhenLow,
    "coverage_cbf": CoverageCBF,
    "coverage_cbf_literal": CoverageCBFLiteral,
    "patrol": Patrol,
    **ADVERSARIES,
    "learned": Learned,
}


def make_controller(
    name: str, config: SurveillanceConfig, seed: int = 0, adversary: str | Path | None = None
) -> Controller:
    """Controller by name.

    Args:
        name: one of :data:`CONTROLLERS`.
        config: the world.
        seed: seed of the controller's own generator.
        adversary: for ``learned`` only: folder of the run that trained it; None = the one that the package ships.

    Returns:
        A TensorDictModule that writes ("agents", "nominal_action").

    Raises:
        ValueError: if the name is unknown, or if the learned adversary does not fit the world.
    """
    if name not in CONTROLLERS:
        raise ValueError(f"controller={name!r} is unknown: choose one of {', '.join(CONTROLLERS)}.")
    if name == "learned":
        return Learned(config, seed, adversary)
    if adversary is not None:
        raise ValueError(f"adversary={adversary} belongs to controller=learned, not to controller={name}.")
    return CONTROLLERS[name](config, seed)
