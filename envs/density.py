"""Density families: what is worth watching, and how it changes.

Each world carries a parameter row ``(B, n_params)`` (none for constant families); the weights of the quadrature points
follow from it, are non-negative and sum to 1.
"""

import math

import torch
from torch import Tensor

from envs.config import SurveillanceConfig
from envs.coverage import quadrature_points, squared_distances

AGE_CELLS = 4  # the age field is observed as the mean over a 4^d partition of the arena


class Density:
    """Density of one world configuration on its quadrature points.

    Attributes:
        points: ``(Q, d)``, m.
        cell_moment: second moment of one quadrature cell, m^2; 0 for the Gaussian families, where adding it would bias J.
        n_params: parameters per world, 0 where the density is constant.
        n_observed: numbers per world that a robot observes of it.
    """

    def __init__(self, config: SurveillanceConfig, device: torch.device | str | None = None) -> None:
        factory = {"dtype": config.torch_dtype, "device": device}
        self.config = config
        self.family = config.density
        self.points, moment = quadrature_points(config.bounds, config.quadrature_resolution, **factory)
        self.cell_moment = moment if self.family in ("uniform", "age") else 0.0
        self.bounds = torch.tensor(config.bounds, **factory)
        self.centers = torch.tensor(config.density_center_positions, **factory)
        n_points, (n_centers, dimension) = len(self.points), self.centers.shape
        self.uniform = torch.full((n_points,), 1 / n_points, **factory)
        moves = self.family == "moving"
        drawn = self.family == "gaussian_mixture" and config.density_per_world
        self.n_params = n_points if self.family == "age" else n_centers * (moves + drawn * dimension)
        self.n_observed = AGE_CELLS**dimension if self.family == "age" else n_centers * dimension * (moves or drawn)
        self._cells = self._partition() if self.family == "age" else None
        constant = self.family == "gaussian_mixture" and not drawn
        self._constant = self._gaussian_weights(self.centers) if constant else None

    def sample(self, batch: int, generator: torch.Generator) -> Tensor:
        """Draw the parameters of ``batch`` new episodes, ``(batch, n_params)``."""
        shape = (batch, self.n_params)
        if self.family == "age":
            return self.points.new_zeros(shape)
        unit = torch.rand(shape, generator=generator, dtype=self.points.dtype, device=self.points.device)
        if self.family == "moving":
            return 2 * math.pi * unit
        low, high = self.bounds.unbind(-1)
        return (
            (low + (high - low) * (0.1 + 0.8 * unit.unflatten(-1, (-1, len(low))))).flatten(-2)
            if self.n_params
            else unit
        )

    def advance(self, params: Tensor, nearest_squared: Tensor) -> Tensor:
        """Parameters one step later.

        Args:
            params: ``(B, n_params)``.
            nearest_squared: ``(B, Q)``, squared distance of every point to the nearest robot, m^2.

        Returns:
            ``(B, n_params)``.
        """
        config = self.config
        if self.family == "moving":
            return (params + 2 * math.pi * config.dt / config.density_period) % (2 * math.pi)
        if self.family == "age":
            seen = nearest_squared <= config.sensing_radius**2
            return torch.where(seen, 0.0, (params + config.dt).clamp_max(config.age_limit))
        return params

    def component_centers(self, params: Tensor) -> Tensor:
        """Centres of the Gaussian components now, ``(B, K, d)`` or ``(K, d)``, m."""
        if self.family == "moving":
            circle = torch.stack([params.cos(), params.sin()], dim=-1)
            padding = circle.new_zeros(*circle.shape[:-1], self.centers.shape[-1] - 2)
            return self.centers + self.config.density_amplitude * torch.cat([circle, padding], dim=-1)
        return params.unflatten(-1, self.centers.shape) if self.n_params else self.centers

    def weights(self, params: Tensor) -> Tensor:
        """Weights of the quadrature points, ``(Q,)`` for a constant density, else ``(B, Q)``; they sum to 1."""
        if self.family == "uniform":
            return self.uniform
        if self.family == "age":
            importance = params + self.config.dt  # never all zero
            return importance / importance.sum(-1, keepdim=True)
        return self._gaussian_weights(self.component_centers(params)) if self._constant is None else self._constant

    def _gaussian_weights(self, centers: Tensor) -> Tensor:
        """Weights under equal Gaussians around ``centers (*B, K, d)``, ``(*B, Q)``."""
        exponent = squared_distances(centers, self.points) * (-0.5 / self.config.density_sigma**2)
        return exponent.logsumexp(-2).softmax(-1)  # finite also where every component underflows

    def observe(self, params: Tensor) -> Tensor:
        """What a robot may know of a density that varies, ``(B, n_observed)``, of order one."""
        if self._cells is not None:
            return params @ self._cells / self.config.age_limit
        if self.n_observed == 0:
            return params[..., :0]
        middle = self.bounds.mean(-1)
        return ((self.component_centers(params) - middle) / self.config.length_scale).flatten(-2)

    def reference_cost(self) -> float:
        """J_ref, the unit of the reward: J with every robot in its slot under the uniform density, whatever the family, m^2."""
        docked = self.points.new_tensor(self.config.slot_positions)[: self.config.n_agents]
        _, cell_moment = quadrature_points(self.config.bounds, self.config.quadrature_resolution)
        return float(squared_distances(docked, self.points).amin(dim=-2).mean()) + cell_moment

    def weights_seen(self, observed: Tensor) -> Tensor:
        """Weights as far as :meth:`observe` tells: of the same centres; the ages of coarse cells. ``(Q,)`` or ``(*B, Q)``."""
        if self._cells is not None:
            importance = observed @ (self._cells > 0).to(observed.dtype).T * self.config.age_limit + self.config.dt
            return importance / importance.sum(-1, keepdim=True)
        if self.n_observed == 0:
            return self.weights(observed)
        middle = self.bounds.mean(-1)
        return self._gaussian_weights(observed.unflatten(-1, self.centers.shape) * self.config.length_scale + middle)

    def _partition(self) -> Tensor:
        """Averaging matrix ``(Q, AGE_CELLS^d)`` from points to the coarse cells."""
        low, high = self.bounds.unbind(-1)
        cell = ((self.points - low) / (high - low) * AGE_CELLS).floor().clamp(0, AGE_CELLS - 1).long()
        strides = torch.tensor([AGE_CELLS**k for k in range(len(low))], device=cell.device)
        one_hot = torch.nn.functional.one_hot((cell * strides).sum(-1), AGE_CELLS ** len(low)).to(self.points.dtype)
        return one_hot / one_hot.sum(0).clamp_min(1)
