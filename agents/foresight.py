"""Where a joint action leads, by the world's own model: what the critics are told besides state and action.

One step changes a robot's place by centimetres and the value by a thousandth, which a critic does not resolve; but it
learns well what batteries and coverage are worth. So it sees those that the actions lead to, and the actors follow the
known slope from action to battery and coverage, and the learned one from there to the value.
"""

import dataclasses

import torch
from torch import Tensor, nn

from envs import SurveillanceConfig
from envs.battery import charging_field
from envs.coverage import coverage_cost, squared_distances
from envs.density import Density
from envs.dynamics import other_indices, take
from envs.observation import observation_fields

POINTS_PER_AXIS = {2: 10, 3: 6}
"""Quadrature points per axis and dimension: the slope of J needs fewer than its value."""


class Foresight(nn.Module):
    """Batteries and coverage cost after every robot has kept its nominal action for a while, without filter and walls.

    Args:
        world: the world.
        steps: how long.
    """

    def __init__(self, world: SurveillanceConfig, steps: int) -> None:
        super().__init__()
        self.world, self.steps = world, steps
        self._on: dict[torch.device, tuple[Density, Tensor, float, dict[str, slice]]] = {}

    @property
    def n_features(self) -> int:
        """Features of a robot."""
        return self.world.n_agents + 1

    def forward(self, observation: Tensor, own: Tensor, others: Tensor) -> Tensor:
        """Features of each robot's critic.

        Args:
            observation: ``(*B, N, n_obs)``.
            own: ``(*B, N, d)``, the action of each robot in its own row, m/s.
            others: ``(*B, N, d)``, the action of each robot in the others' rows, m/s; may be ``own`` itself.

        Returns:
            ``(*B, N, N + 1)``: batteries, own first, then in the observation's order, as shares, and the coverage cost in
            units of half the reward's J_ref.
        """
        world, (density, stations, reference_cost, fields) = self.world, self._tools(observation)
        n, way = world.n_agents, self.steps * world.dt
        position = observation[..., fields["position"]] * world.length_scale + density.bounds.mean(-1)
        share = observation[..., fields["energy"]].squeeze(-1)
        my = position + way * own
        their = my if others is own else position + way * others
        radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}
        span = world.energy_max - world.energy_min

        def battery(place: Tensor) -> Tensor:
            power = world.charge_rate * charging_field(place, stations, **radii) - world.drain_rate
            return (share + way * power / span).clamp_max(1)

        own_battery = battery(my)
        others_battery = take(own_battery if others is own else battery(their), other_indices(n, observation.device))
        weights = density.weights_seen(observation[..., :1, fields["density"]].squeeze(-2))
        if others is own:
            cost = coverage_cost(my, density.points, weights, density.cell_moment).unsqueeze(-1).expand_as(share)
        else:
            cost = cost_of_own(my, their, density.points, weights) + density.cell_moment
        return torch.cat([own_battery.unsqueeze(-1), others_battery, cost.unsqueeze(-1) * (2 / reference_cost)], dim=-1)

    def _tools(self, like: Tensor) -> tuple[Density, Tensor, float, dict[str, slice]]:
        """Density on few points, stations ``(M, d)``, J_ref and the observation's fields, on the device of ``like``."""
        if like.device not in self._on:
            coarse = dataclasses.replace(self.world, resolution=POINTS_PER_AXIS[self.world.dimension])
            stations = torch.tensor(coarse.station_positions, dtype=coarse.torch_dtype, device=like.device)
            reference_cost = Density(self.world, like.device).reference_cost()  # of the reward, on all points
            density = Density(coarse, like.device)
            self._on[like.device] = (density, stations, reference_cost, observation_fields(self.world, density))
        return self._on[like.device]


def cost_of_own(own: Tensor, others: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Coverage cost as each robot would have it: itself at ``own``, the others at ``others``; differentiable in ``own``.

    The gradient is written out, ``2 sum_q w_q (p_i - q)`` over the points that are nearest to robot i, so that nothing
    of the size of the quadrature is kept for the backward pass.

    Args:
        own: ``(*B, N, d)``, m.
        others: ``(*B, N, d)``, m.
        points: ``(Q, d)``, m.
        weights: ``(Q,)`` or ``(*B, Q)``, summing to 1.

    Returns:
        ``(*B, N)``, m^2, without the cell's own moment.

    Source: Cortes et al., Coverage control for mobile sensing networks (2004), the gradient of the locational cost.
    """
    with torch.no_grad():
        squared, weights = squared_distances(own, points), weights.unsqueeze(-2)
        nearest, mine = squared, weights.expand_as(squared)
        if own.shape[-2] > 1:
            rest = take(squared_distances(others, points), other_indices(own.shape[-2], own.device), -2).amin(dim=-2)
            # the comparison as 0 or 1: a product with a bool takes four times as long
            mine = weights * torch.lt(squared, rest, out=torch.empty_like(squared))
            nearest = torch.minimum(squared, rest)
        value = (nearest * weights).sum(-1)
        slope = 2 * (own * mine.sum(-1, keepdim=True) - mine @ points)
    return value + ((own - own.detach()) * slope).sum(-1)
