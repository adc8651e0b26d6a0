"""Motion of the robots: single integrator, exact under a zero-order hold, with a Euclidean speed limit."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

TINY_SQUARE = 1e-37  # below it a squared length is 0
CUT_SPEED = 1 - 7e-7
"""Share of the limit that faster velocities are cut to: by less than a correction counts from (1e-6, :mod:`safety.statistics`)."""
FULL_SPEED = 1 - 3.7e-7
"""Share of the limit up to which a filter leaves a velocity as it is. Two orders of summation of a float32 norm differ by less than
the rest, so whoever checks an executed speed finds it within the limit; and a velocity that was cut is not cut again."""


def limit_speed(velocity: Tensor, max_speed: float, full: float = 1.0) -> Tensor:
    """Scale velocities outside the speed ball into it; others are returned bit for bit.

    Args:
        velocity: ``(*B, N, d)``, m/s.
        max_speed: radius of the ball, m/s.
        full: share of ``max_speed`` above which a velocity is scaled, at least :data:`FULL_SPEED`.

    Returns:
        ``(*B, N, d)``, m/s, norm at most ``max_speed``: to a rounding, whatever the order of summation with ``FULL_SPEED``.
    """
    speed = length(velocity).unsqueeze(-1)
    return torch.where(speed > max_speed * full, velocity * (max_speed * CUT_SPEED / speed), velocity)


def integrate(position: Tensor, velocity: Tensor, dt: float) -> Tensor:
    """Single integrator ``p+ = p + dt u``.

    Args:
        position: ``(*B, N, d)``, m.
        velocity: ``(*B, N, d)``, m/s, constant over the step.
        dt: length of the step, s.

    Returns:
        ``(*B, N, d)``, m.
    """
    return position + dt * velocity


def constant(make: Callable[..., T]) -> Callable[..., T]:
    """Decorate a function of hashable arguments that returns tensors: made once, and fit for autograd whoever asks first.

    Kept for good: a recording (:mod:`envs.graphs`) knows them by their addresses.
    """
    cached = functools.cache(torch.inference_mode(False)(make))

    @torch.compiler.assume_constant_result
    @functools.wraps(make)
    def made(*args: Any) -> T:
        return cached(*args)

    return made


@constant
def other_indices(n_agents: int, device: torch.device | None = None) -> Tensor:
    """Row i holds the other robots in cyclic order, ``i + 1, i + 2, ..``: ``(N, N - 1)`` int64."""
    robots = torch.arange(n_agents, device=device)
    return (robots.unsqueeze(-1) + robots[1:]) % n_agents


@constant
def pair_indices(n_agents: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Indices ``(i, j)``, ``i < j``, of all pairs of robots, each ``(P,)`` with ``P = N (N - 1) / 2``."""
    i, j = torch.triu_indices(n_agents, n_agents, offset=1, device=device)
    return i, j


@constant
def own_pairs(n_agents: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Robot i's pairs, others in cyclic order, and its side in them (0 in pair (i, j), 1 in (j, i)): ``(N, N - 1)`` each."""
    i, j = pair_indices(n_agents, device)
    others = other_indices(n_agents, device)
    robots = torch.arange(n_agents, device=device).unsqueeze(-1)
    number = torch.zeros(n_agents, n_agents, dtype=torch.int64, device=device)
    number[i, j] = number[j, i] = torch.arange(len(i), device=device)
    return number[robots, others], (robots > others).to(torch.int64)


def take(x: Tensor, index: Tensor, dim: int = -1) -> Tensor:
    """``x[..., index]`` along a dimension, for an index of any shape: two to six times as fast as PyTorch's indexing."""
    picked = x.index_select(dim, index.flatten())
    return picked if index.dim() == 1 else picked.unflatten(dim, index.shape)


def components_first(x: Tensor) -> Tensor:
    """The same tensor ``(..., d)`` with its components stored one after the other.

    Loops run along the memory: over a short last dimension, every broadcast along it (a norm, a mask) costs ten times
    what it does over long runs. Elementwise results keep the order.
    """
    return x.movedim(-1, 0).contiguous().movedim(0, -1)


def batch_last(x: Tensor) -> Tensor:
    """The same tensor ``(B, ...)`` with the batch's elements stored next to each other, as :func:`components_first`."""
    return x.permute(*reversed(range(x.dim()))).contiguous().permute(*reversed(range(x.dim())))


def length(x: Tensor) -> Tensor:
    """Norm over a short last dimension, as :func:`dot`; 0 is 3e-19, to divide by, and its gradient there 0."""
    return dot(x, x).clamp_min(TINY_SQUARE).sqrt()


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products over a short last dimension, whose reduction is slow otherwise: ``(*B, d), (*B, d) -> (*B)``."""
    products = (a * b).unbind(-1)
    total = products[0]
    for product in products[1:]:
        total = total + product
    return total
