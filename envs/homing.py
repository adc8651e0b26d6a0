"""Driving home: energy reserve, closest approach of two robots driving home, the certified set and slot reassignment.

The backup motion of robot i is "straight to your slot": at speed ``v`` until it stops in the slot (linear family) or
exponentially, ``u = -k (p - sigma)`` (logarithmic family). A state is **certified** when, under this joint motion,
no robot runs empty and no two robots come closer than ``clearance``:

    E_i - E_min >= rho(||p_i - sigma_i||),   E_i <= E_max,   G_ij >= clearance for all i < j,   p_i in the arena.

The set is invariant under the joint backup motion; keeping every robot inside it is what a certified filter does.
Source: Notomista & Egerstedt, Persistification of Robotic Tasks (arXiv 1903.05810) for the reserve; the closest
approach ``G`` of the exact piecewise linear paths is this project's (../docs/safety.md once the certified filter lands).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.dynamics import pair_indices


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
    distance = offset.norm(dim=-1, keepdim=True)
    return offset * torch.clamp(geometry.speed / distance.clamp_min(1e-30), max=1 / geometry.dt)


def closest_approach(position: Tensor, slot_position: Tensor, geometry: HomingGeometry) -> Tensor:
    """Exact minimum distance ``G_ij`` of every pair of robots while all drive home, between samples included.

    Linear family: the distance to go falls by ``v dt`` a step, and by what is left in the last one, so both paths are
    linear between the sorted times ``{0, n_i, n_i + 1, n_j, n_j + 1}``, ``n = floor(D / (v dt))``: the minimum over
    four point-to-segment distances. Logarithmic family: the difference of two robots moves on a straight segment.

    Args:
        position: ``(*B, N, d)``, m.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.

    Returns:
        ``(*B, P)``, m, pairs in ``torch.triu_indices`` order.
    """
    i, j = pair_indices(position.shape[-2], position.device)
    offset = position - slot_position
    if geometry.family == "logarithmic":
        start = position[..., i, :] - position[..., j, :]
        end = slot_position[..., i, :] - slot_position[..., j, :]
        return segment_distance(start, end)
    distance = offset.norm(dim=-1)
    direction = offset / distance.clamp_min(1e-30).unsqueeze(-1)
    step = geometry.speed * geometry.dt
    whole = (distance / step).floor()
    zero = torch.zeros_like(whole[..., i])
    times, _ = torch.stack([zero, whole[..., i], whole[..., i] + 1, whole[..., j], whole[..., j] + 1], dim=-1).sort(
        dim=-1
    )

    def path(robot: Tensor) -> Tensor:
        """Position of ``robot`` at ``times``, ``(*B, P, 5, d)``."""
        d, n = distance[..., robot, None], whole[..., robot, None]
        to_go = torch.where(times <= n, d - times * step, (d - n * step) * (n + 1 - times)).clamp_min(0)
        return slot_position[..., robot, None, :] + direction[..., robot, None, :] * to_go.unsqueeze(-1)

    relative = path(i) - path(j)
    return segment_distance(relative[..., :-1, :], relative[..., 1:, :]).amin(dim=-1)


def segment_distance(start: Tensor, end: Tensor) -> Tensor:
    """Distance of the origin to the segment from ``start`` to ``end``, ``(..., d), (..., d) -> (...)``."""
    along = end - start
    t = (-(start * along).sum(-1) / along.square().sum(-1).clamp_min(1e-30)).clamp(0, 1)
    return (start + t.unsqueeze(-1) * along).norm(dim=-1)


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

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.
        bounds: ``(d, 2)``, the arena, m.
        clearance: distance demanded on top of ``geometry.clearance``, m.

    Returns:
        ``(*B,)`` bool.
    """
    distance = (position - slot_position).norm(dim=-1)
    margin = energy - geometry.energy_min - 2 * geometry.eps_energy - reserve(distance, geometry)
    inside = ((position >= bounds[:, 0]) & (position <= bounds[:, 1])).all(dim=-1)
    robots = ((margin >= 0) & (energy <= geometry.energy_max) & inside).all(dim=-1)
    apart = (
        closest_approach(position, slot_position, geometry) >= geometry.clearance + geometry.eps_distance + clearance
    )
    return robots & apart.all(dim=-1)


def exchange_slots(position: Tensor, energy: Tensor, slot: Tensor, slots: Tensor, geometry: HomingGeometry) -> Tensor:
    """The one exchange (or move to a free slot) that shortens the squared way home most; no change where none does.

    Robot i takes slot s; the robot that owned s, if any, takes i's. Both must keep their energy reserve.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot: ``(*B, N)`` int64, a one-to-one assignment.
        slots: ``(S, d)``, m.
        geometry: constants of the backup motion.

    Returns:
        ``(*B, N)`` int64, one-to-one.
    """
    n_slots = slots.shape[0]
    way = (position.unsqueeze(-2) - slots).norm(dim=-1)  # robot i to slot s: (*B, N, S)
    affordable = energy.unsqueeze(-1) - geometry.energy_min - 2 * geometry.eps_energy >= reserve(way, geometry)
    cost = torch.where(affordable, way.square(), torch.inf)
    own_way = way.gather(-1, slot.unsqueeze(-1)).square()  # (*B, N, 1)
    owner = torch.nn.functional.one_hot(slot, n_slots).to(way.dtype)  # robot j owns slot s
    taken = owner.sum(dim=-2, keepdim=True) > 0  # (*B, 1, S)
    # cost of slot s's owner j in robot i's slot: cross[i, s] = cost[j(s), slot_i], 0 for a free slot
    in_slot_of = cost.gather(-1, slot.unsqueeze(-2).expand(*slot.shape, slot.shape[-1]))  # robot j in robot i's slot
    owner_of = owner.argmax(dim=-2)  # (*B, S), 0 for a free slot (masked below)
    cross = in_slot_of.transpose(-1, -2).gather(-1, owner_of.unsqueeze(-2).expand(*way.shape))
    owner_way = own_way.squeeze(-1).gather(-1, owner_of).unsqueeze(-2)
    zero = torch.zeros((), dtype=way.dtype, device=way.device)
    gain = own_way - cost + torch.where(taken, owner_way - cross, zero)
    best, index = gain.nan_to_num(nan=-torch.inf).flatten(-2).max(dim=-1)
    robot, target = index // n_slots, index % n_slots
    robots = torch.arange(slot.shape[-1], device=slot.device)
    old = slot.gather(-1, robot.unsqueeze(-1))
    swapped = torch.where(slot == target.unsqueeze(-1), old, slot)
    swapped = torch.where(robots == robot.unsqueeze(-1), target.unsqueeze(-1), swapped)
    # a relative threshold: rounding must not make two robots trade slots for ever
    worth = best > 1e-5 * geometry.charge_radius**2
    return torch.where(worth.unsqueeze(-1), swapped, slot)


def reassign_slots(
    position: Tensor, energy: Tensor, slot: Tensor, slots: Tensor, geometry: HomingGeometry, bounds: Tensor
) -> Tensor:
    """Adopt the best exchange of slots exactly where the state is certified under it (SAFETY section 4.4).

    Args and shapes as :func:`exchange_slots`; ``bounds`` ``(d, 2)`` is the arena.

    Returns:
        ``(*B, N)`` int64, one-to-one.
    """
    candidate = exchange_slots(position, energy, slot, slots, geometry)
    adopt = is_certified(position, energy, slots[candidate], geometry, bounds)
    return torch.where(adopt.unsqueeze(-1), candidate, slot)
