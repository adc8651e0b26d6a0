"""Voronoi coverage: the locational cost J and its gradient by quadrature on a regular grid.

``J(x) = int min_i ||p_i - q||^2 phi(q) dq`` with the density normalised to 1. Every cell of the grid is represented by
its centre. For a density that does not vanish at the walls the cell's own second moment is added (parallel axis
theorem: exact for one robot and a uniform density); for a smooth density inside the arena the midpoint rule needs no
correction and the moment would be a bias.
"""

import math

import torch
from torch import Tensor

from envs.dynamics import dot


def quadrature_points(bounds: list[list[float]], resolution: int, **factory) -> tuple[Tensor, float]:
    """Centres of a regular grid over a box, and the second moment of one cell.

    Args:
        bounds: ``[low, high]`` per axis, m.
        resolution: cells per axis.
        **factory: ``dtype`` and ``device`` of the result.

    Returns:
        Points ``(Q, d)``, m, row-major over the axes, and ``sum_axes (side^2 / 12)``, m^2.
    """
    axes = [low + (high - low) * (torch.arange(resolution, **factory) + 0.5) / resolution for low, high in bounds]
    points = torch.stack([g.flatten() for g in torch.meshgrid(*axes, indexing="ij")], dim=-1)
    return points, math.fsum(((high - low) / resolution) ** 2 / 12 for low, high in bounds)


def squared_distances(position: Tensor, points: Tensor, *, clamp: bool = True) -> Tensor:
    """Squared distances of robots and points, ``(*B, N, d), (Q, d) -> (*B, N, Q)``, m^2.

    One matrix product, ``(p, |p|^2, 1) . (-2 q, 1, |q|^2)``, about the middle of the points, so that an arena far from
    the origin loses no digits. ``clamp`` removes what rounding leaves below zero.
    """
    middle = points.mean(dim=0)
    p, q = position - middle, points - middle
    ones = (torch.ones_like(p[..., :1]), torch.ones_like(q[:, :1]))
    left = torch.cat([p, dot(p, p).unsqueeze(-1), ones[0]], dim=-1)
    squared = left @ torch.cat([-2 * q, ones[1], dot(q, q).unsqueeze(-1)], dim=-1).T
    return squared.clamp_min(0) if clamp else squared


def coverage_cost(position: Tensor, points: Tensor, weights: Tensor, cell_moment: float) -> Tensor:
    """Locational cost ``J = sum_q w_q min_i ||p_i - q||^2 + cell_moment``.

    Args:
        position: ``(*B, N, d)``, m.
        points: ``(Q, d)``, m.
        weights: ``(Q,)`` or ``(*B, Q)``, summing to 1.
        cell_moment: correction for the cells' own extent, m^2, see :class:`envs.density.Density`.

    Returns:
        ``(*B,)``, m^2.

    Source: Cortes et al., Coverage control for mobile sensing networks (2004): the locational optimisation function.
    """
    return weighted_sum(squared_distances(position, points).amin(dim=-2), weights) + cell_moment


def weighted_sum(values: Tensor, weights: Tensor) -> Tensor:
    """Sum over the quadrature points, ``(*B, Q)`` and ``(Q,)`` or ``(*B, Q)`` to ``(*B,)``.

    Several batches ``(K, B, Q)`` give each the bits that it has alone: the order in which a matrix-vector product adds up
    depends on the number of rows.
    """
    if weights.dim() > 1:
        return (values * weights).sum(-1)
    return values @ weights if values.dim() < 3 else torch.stack([weighted_sum(own, weights) for own in values])


def voronoi_moments(
    position: Tensor, points: Tensor, weights: Tensor, squared: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Mass and centroid of every robot's Voronoi cell.

    Args:
        position: ``(*B, N, d)``, m.
        points: ``(Q, d)``, m.
        weights: ``(Q,)`` or ``(*B, Q)``, summing to 1.
        squared: their :func:`squared_distances`, if they are known.

    Returns:
        Mass ``(*B, N)`` and centroid ``(*B, N, d)``, m; the centroid of a cell without mass is the robot itself.
    """
    squared = squared_distances(position, points) if squared is None else squared
    nearest = squared.min(dim=-2, keepdim=True).indices  # the first, as argmin, in a tenth of its time
    robots = torch.arange(position.shape[-2], device=position.device).unsqueeze(-1)
    owned = (nearest == robots).to(position.dtype) * weights.unsqueeze(-2)
    mass = owned.sum(-1)
    moment = owned @ points
    safe = mass.clamp_min(torch.finfo(position.dtype).tiny).unsqueeze(-1)
    return mass, torch.where(mass.unsqueeze(-1) > 0, moment / safe, position)


def coverage_gradient(position: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Gradient of J: ``dJ/dp_i = 2 m_i (p_i - c_i)``, ``(*B, N, d)``, m.

    Args and source as :func:`coverage_cost`; ``m_i, c_i`` are mass and centroid of robot i's cell.
    """
    mass, centroid = voronoi_moments(position, points, weights)
    return 2 * mass.unsqueeze(-1) * (position - centroid)
