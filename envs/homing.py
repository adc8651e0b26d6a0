"""Driving home: energy reserve, closest approach of two robots driving home, and the certified set.

The backup motion of robot i is "straight to your slot": at speed ``v`` until it stops in the slot (linear family) or
exponentially, ``u = -k (p - sigma)`` (logarithmic family). A state is **certified** when, under this joint motion,
no robot runs empty and no two robots come closer than ``clearance``:

    E_i - E_min >= rho(||p_i - sigma_i||),   E_i <= E_max,   G_ij >= clearance for all i < j,   p_i in the arena.

The set is invariant under the joint backup motion; keeping every robot inside it is what a certified filter does.
Source: Notomista & Egerstedt, Persistification of Robotic Tasks (arXiv 1903.05810) for the reserve; the closest
approach ``G`` of the exact piecewise linear paths is this project's (docs/safety.md).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from envs.dynamics import length, pair_indices, take

TINY = 1e-30  # below it a length is 0


@dataclass(frozen=True)
class HomingGeometry:
    """Constants of the backup motion, derived from :class:`envs.config.SurveillanceConfig`."""

    family: str
    """linear | logarithmic."""
    drain_rate: float
    """Drain that the reserve counts with, energy/s."""
    speed: float
    """Speed ``v`` of driving home (linear family), m/s."""
    gain: float
    """Gain ``k`` of the exponential approach (logarithmic family), 1/s."""
    dt: float
    """Length of a step, s."""
    charge_radius: float
    """Distance ``r_c`` to the slot inside which the net charging rate can be >= 0, m."""
    reserve_radius: float
    """Distance ``r_rho`` at which the reserve reaches 0, one backup step inside ``r_c``, m."""
    clearance: float
    """Distance ``Delta_G`` that two homing robots must keep, m."""
    energy_min: float
    """E_min."""
    energy_max: float
    """E_max."""
    eps_energy: float
    """Rounding margin in energy; entering the set demands two of it, staying inside one."""
    eps_distance: float
    """Rounding margin in distance, m."""

    @property
    def decay(self) -> float:
        """Rate ``k~ = -ln(1 - k dt) / dt`` of the exact discrete exponential approach, 1/s."""
        return -math.log1p(-self.gain * self.dt) / self.dt


def reserve(distance: Tensor, geometry: HomingGeometry, *, radius: float | None = None) -> Tensor:
    """Energy ``rho`` needed to drive home from ``distance``.

    Linear: ``(K_d / v) max(0, D - r)``. Logarithmic: ``(K_d / k~) max(0, ln(D / r))``.

    Args:
        distance: ``(...)``, distance to the own slot, m.
        geometry: constants of the backup motion.
        radius: where the reserve ends, m; the sampled-data ``reserve_radius`` if not given.

    Returns:
        ``(...)``, energy.
    """
    radius = geometry.reserve_radius if radius is None else radius
    if geometry.family == "linear":
        return (geometry.drain_rate / geometry.speed) * (distance - radius).clamp_min(0)
    return (geometry.drain_rate / geometry.decay) * (distance / radius).clamp_min(1).log()


def homing_velocity(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> Tensor:
    """Velocity of the backup motion; it stops exactly in the slot.

    Args:
        position: ``(*B, N, d)``, m.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.

    Returns:
        ``(*B, N, d)``, m/s.
    """
    offset = slot_position - position
    if geometry.family == "logarithmic":
        return geometry.gain * offset
    distance = length(offset).unsqueeze(-1)
    return offset * torch.clamp(geometry.speed / distance, max=1 / geometry.dt)


class ClosestPieces(NamedTuple):
    """Where two homing robots come closest on each of the S straight pieces of their relative path."""

    distance: Tensor
    """Distance then, ``(S, *B, P)``, m; its least is ``G``."""
    relative: Tensor
    """Relative position ``xi_i - xi_j`` then, ``(S, d, *B, P)``, m."""
    time: Tensor
    """When, ``(S, *B, P)``: in steps (linear family), or the share of the way done (logarithmic)."""


class ClosestMoments(NamedTuple):
    """:class:`ClosestPieces` with what the distance's gradient needs of robots i and j."""

    distance: Tensor
    """``(S, *B, P)``, m."""
    relative: Tensor
    """``(S, d, *B, P)``, m."""
    share: Tensor
    """``l / D``: share of the way home still to go for i and j, ``(S, 2, *B, P)``."""
    slope: Tensor
    """``dl / dD``: by how much the way to go grows with the distance at the start, for i and j, ``(S, 2, *B, P)``."""


def closest_approach(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> Tensor:
    """Exact minimum distance ``G_ij`` of every pair of robots while all drive home, between samples included.

    Linear family: the distance to go falls by ``v dt`` a step, and by what is left in the last one, so both paths are
    linear between the times ``{0, n_i, n_i + 1, n_j, n_j + 1}``, ``n = floor(D / (v dt))``: the minimum over four
    point-to-segment distances. Logarithmic family: the difference of two robots moves on a straight segment.

    Args:
        position: ``(*B, N, d)``, m.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.

    Returns:
        ``(*B, P)``, m, pairs in ``torch.triu_indices`` order.
    """
    return closest_pieces(position, slot_position, geometry).distance.amin(dim=0)


def closest_pieces(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> ClosestPieces:
    """The closest approach on each straight piece; arguments as :func:`closest_approach`."""
    if geometry.family == "logarithmic":
        corners = torch.stack(_relative_ends(position, slot_position)).movedim(-1, 1)
        times = torch.arange(2, dtype=position.dtype, device=position.device).view(2, *[1] * (corners.dim() - 2))
    else:
        times, corners = _relative_path(position, slot_position, geometry)
    start, first = corners[:-1], times[:-1]
    along = corners[1:] - start
    t = (-(start * along).sum(1) / along.square().sum(1).clamp_min(TINY)).clamp(0, 1)
    relative = torch.addcmul(start, t.unsqueeze(1), along)
    return ClosestPieces(relative.square().sum(1).sqrt(), relative, torch.addcmul(first, t, times[1:] - first))


def way_to_go(distance: Tensor, time: Tensor, geometry: HomingGeometry) -> tuple[Tensor, Tensor]:
    """Share of the way home that is left at ``time``, and its slope ``dl / dD``.

    Args:
        distance: ``(...)``, distance to the own slot at the start, m, as :func:`envs.dynamics.length` gives it: not 0.
        time: ``(...)``, as in :class:`ClosestPieces`.
        geometry: constants of the backup motion.

    Returns:
        ``l / D`` and ``dl / dD``, both ``(...)``.
    """
    if geometry.family == "logarithmic":
        share = torch.ones_like(distance) - time
        return share, share
    whole = (distance / (geometry.speed * geometry.dt)).floor()
    slope = torch.where(time <= whole, 1.0, (whole + 1 - time).clamp_min(0))
    return _to_go(distance, whole, time, geometry) / distance, slope


def closest_moments(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> ClosestMoments:
    """:func:`closest_pieces` with both robots' way to go; arguments as :func:`closest_approach`."""
    pieces = closest_pieces(position, slot_position, geometry)
    way = length(position - slot_position)
    distance = torch.stack([way[..., x] for x in pair_indices(position.shape[-2], position.device)])
    share, slope = way_to_go(distance, pieces.time.unsqueeze(1), geometry)
    return ClosestMoments(pieces.distance, pieces.relative, share, slope)


def _relative_ends(position: Tensor, slot_position: Tensor) -> tuple[Tensor, Tensor]:
    """Relative positions of all pairs now and in their slots, ``(*B, P, d)`` each."""
    i, j = pair_indices(position.shape[-2], position.device)
    return position[..., i, :] - position[..., j, :], slot_position[..., i, :] - slot_position[..., j, :]


def _relative_path(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> tuple[Tensor, Tensor]:
    """Corners of the relative homing path of every pair (linear family).

    Returns:
        Times ``(5, *B, P)`` in steps and relative positions ``(5, d, *B, P)``: leading dimensions first, as sums over
        long runs are fast.
    """
    i, j = pair_indices(position.shape[-2], position.device)
    offset = position - slot_position
    distance = length(offset)
    direction = (offset / distance.unsqueeze(-1)).movedim(-1, 0)  # (d, *B, N)
    whole = (distance / (geometry.speed * geometry.dt)).floor()
    n_i, n_j = take(whole, i), take(whole, j)
    first, last = torch.minimum(n_i, n_j), torch.maximum(n_i, n_j)
    times = torch.stack([torch.zeros_like(first), first, first + 1, torch.maximum(last, first + 1), last + 1])
    slots = slot_position.movedim(-1, 0)
    way_i = take(direction, i) * _to_go(take(distance, i), n_i, times, geometry).unsqueeze(1)
    way_j = take(direction, j) * _to_go(take(distance, j), n_j, times, geometry).unsqueeze(1)
    # in this order and with no fused product, two robots that mirror each other keep an offset of exactly 0
    return times, (take(slots, i) - take(slots, j)) + (way_i - way_j)


def _to_go(distance: Tensor, whole: Tensor, times: Tensor, geometry: HomingGeometry) -> Tensor:
    """Distance to the slot at ``times``, in steps, under the backup motion."""
    step = geometry.speed * geometry.dt
    last_step = (distance - whole * step) * (whole + 1 - times)
    return torch.where(times <= whole, distance - times * step, last_step).clamp_min(0)


def certified_robots(
    position: Tensor, energy: Tensor, slot_position: Tensor, geometry: HomingGeometry, bounds: Tensor, *, margins: int
) -> Tensor:
    """Which robots satisfy their own part of the certified set, with ``margins`` rounding margins.

    Two margins are demanded on entry (start states, slot reassignment, rows of a filter), one of the states that a
    filter's shield accepts, none of a state that is still called certified: each step may lose a few roundings.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.
        bounds: ``(d, 2)``, the arena, m.
        margins: 0, 1 or 2.

    Returns:
        ``(*B, N)`` bool; NaN fails.
    """
    offset = position - slot_position
    distance = length(offset)
    spare = energy - geometry.energy_min - margins * geometry.eps_energy - reserve(distance, geometry)
    wall = (3 - margins) / 2 * geometry.eps_distance  # a robot at the wall must not leave the set by one rounding
    inside = ((position >= bounds[:, 0] - wall) & (position <= bounds[:, 1] + wall)).all(dim=-1)
    return (spare >= 0) & (energy <= geometry.energy_max) & inside


def certified_pairs(closest: Tensor, geometry: HomingGeometry, *, margins: int) -> Tensor:
    """Which pairs, given their closest approach ``(*B, P)`` in m, satisfy theirs; margins as :func:`certified_robots`."""
    return closest >= geometry.clearance + (margins - 1) * geometry.eps_distance


def certified_parts(
    position: Tensor, energy: Tensor, slot_position: Tensor, geometry: HomingGeometry, bounds: Tensor, *, margins: int
) -> tuple[Tensor, Tensor]:
    """:func:`certified_robots` ``(*B, N)`` and :func:`certified_pairs` ``(*B, P)`` of a state."""
    robots = certified_robots(position, energy, slot_position, geometry, bounds, margins=margins)
    closest = closest_approach(position, slot_position, geometry)
    return robots, certified_pairs(closest, geometry, margins=margins)


def is_certified(
    position: Tensor,
    energy: Tensor,
    slot_position: Tensor,
    geometry: HomingGeometry,
    bounds: Tensor,
    *,
    clearance: float = 0.0,
) -> Tensor:
    """Whether a joint state is in the certified set, with the margins demanded on entry (two rounding margins).

    Args and shapes as :func:`certified_robots`; ``clearance`` (m) is demanded on top of ``geometry.clearance``.

    Returns:
        ``(*B,)`` bool.
    """
    geometry = replace(geometry, clearance=geometry.clearance + clearance)
    robots, pairs = certified_parts(position, energy, slot_position, geometry, bounds, margins=2)
    return robots.all(dim=-1) & pairs.all(dim=-1)
