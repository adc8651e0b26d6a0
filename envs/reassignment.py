"""Which robot charges where: exchanges of slots that shorten the way home and keep the state certified."""

import torch
from torch import Tensor

from envs.dynamics import dot, length, pair_indices
from envs.homing import HomingGeometry, is_certified, reserve
from envs.selection import places

EXCHANGES = 4  # exchanges of slots whose certificate is tried in a step


def exchange_slots(position: Tensor, energy: Tensor, slot: Tensor, slots: Tensor, geometry: HomingGeometry) -> Tensor:
    """The first of :func:`best_exchanges`, ``(*B, N)`` int64."""
    return best_exchanges(position, energy, slot, slots, geometry, 1).squeeze(-2)


def best_exchanges(
    position: Tensor, energy: Tensor, slot: Tensor, slots: Tensor, geometry: HomingGeometry, count: int
) -> Tensor:
    """The exchanges (or moves to a free slot) that shorten the squared way home most; no change where none does.

    Robot i takes slot s; the robot that owned s, if any, takes i's. Both must keep their energy reserve.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot: ``(*B, N)`` int64, a one-to-one assignment.
        slots: ``(S, d)``, m.
        geometry: constants of the backup motion.
        count: number of exchanges asked for, at most N S.

    Returns:
        ``(*B, count, N)`` int64, each one-to-one, the best one first.
    """
    n_slots = slots.shape[0]
    way = length(position.unsqueeze(-2) - slots)  # robot i to slot s: (*B, N, S)
    affordable = energy.unsqueeze(-1) - geometry.energy_min - 2 * geometry.eps_energy >= reserve(way, geometry)
    cost = torch.where(affordable, way.square(), torch.inf)
    own_way = way.gather(-1, slot.unsqueeze(-1)).square()  # (*B, N, 1)
    owner = (slot.unsqueeze(-1) == torch.arange(n_slots, device=slot.device)).to(way.dtype)  # robot j owns slot s
    taken = owner.sum(dim=-2, keepdim=True) > 0  # (*B, 1, S)
    # cost of slot s's owner j in robot i's slot: cross[i, s] = cost[j(s), slot_i], 0 for a free slot
    in_slot_of = cost.gather(-1, slot.unsqueeze(-2).expand(*slot.shape, slot.shape[-1]))  # robot j in robot i's slot
    owner_of = owner.argmax(dim=-2)  # (*B, S), 0 for a free slot (masked below)
    cross = in_slot_of.transpose(-1, -2).gather(-1, owner_of.unsqueeze(-2).expand(*way.shape))
    owner_way = own_way.squeeze(-1).gather(-1, owner_of).unsqueeze(-2)
    zero = torch.zeros((), dtype=way.dtype, device=way.device)
    gain = own_way - cost + torch.where(taken, owner_way - cross, zero)
    robots = torch.arange(slot.shape[-1], device=slot.device)
    twice = taken & (owner_of.unsqueeze(-2) < robots.unsqueeze(-1))  # an exchange of two robots counts once
    best, index = gain.nan_to_num(nan=-torch.inf).masked_fill(twice, -torch.inf).flatten(-2).topk(count, dim=-1)
    robot, target = index // n_slots, (index % n_slots).unsqueeze(-1)
    old = slot.gather(-1, robot).unsqueeze(-1)
    swapped = torch.where(slot.unsqueeze(-2) == target, old, slot.unsqueeze(-2))
    swapped = torch.where(robots == robot.unsqueeze(-1), target, swapped)
    # a relative threshold: rounding must not make two robots trade slots for ever
    worth = best > 1e-5 * geometry.charge_radius**2
    return torch.where(worth.unsqueeze(-1), swapped, slot.unsqueeze(-2))


def reassign_slots(
    position: Tensor,
    energy: Tensor,
    slot: Tensor,
    slots: Tensor,
    geometry: HomingGeometry,
    bounds: Tensor,
    *,
    fixed_sizes: bool = False,
) -> Tensor:
    """Adopt the best of a few exchanges under which the state is certified, none where there is no such (docs/safety.md, 9).

    Args and shapes as :func:`best_exchanges`; ``bounds`` ``(d, 2)`` is the arena; ``fixed_sizes`` looks at all worlds and
    exchanges, with the same results (:mod:`envs.selection`).

    Returns:
        ``(*B, N)`` int64, one-to-one.
    """
    n, d = position.shape[-2:]
    flat = position.reshape(-1, n, d), energy.reshape(-1, n), slot.reshape(-1, n)
    (index,) = places(_may_exchange(flat[0], flat[2], slots), fixed_sizes=fixed_sizes)
    some_position, some_energy, some_slot = (x[index] for x in flat)
    count = min(EXCHANGES, slot.shape[-1] * len(slots))
    candidates = best_exchanges(some_position, some_energy, some_slot, slots, geometry, count)
    # few kinds of exchange have anything to offer
    differs = (candidates != some_slot.unsqueeze(-2)).any(dim=-1)
    some = places(differs, fixed_sizes=fixed_sizes)
    adopt = torch.zeros_like(differs)
    home = slots[candidates[some]]
    adopt[some] = is_certified(some_position[some[0]], some_energy[some[0]], home, geometry, bounds)
    adopt = adopt & differs
    first = adopt.to(torch.uint8).argmax(dim=-1, keepdim=True)
    chosen = candidates.gather(-2, first.unsqueeze(-1).expand(*first.shape, slot.shape[-1])).squeeze(-2)
    chosen = torch.where(adopt.any(dim=-1, keepdim=True), chosen, some_slot)
    return flat[2].index_copy(0, index, chosen).view_as(slot)


def _may_exchange(position: Tensor, slot: Tensor, slots: Tensor) -> Tensor:
    """Worlds in which an exchange may shorten the squared way home, ``(M,)``; all worlds that have one are among them."""
    home = slots[slot]
    i, j = pair_indices(slot.shape[-1], slot.device)
    # |p_i - s_i|^2 + |p_j - s_j|^2 - |p_i - s_j|^2 - |p_j - s_i|^2 = -2 (p_i - p_j) . (s_i - s_j)
    some = (dot(position[:, i] - position[:, j], home[:, i] - home[:, j]) < 0).any(dim=-1)
    if len(slots) > slot.shape[-1]:  # a free slot
        nearest = length(position.unsqueeze(-2) - slots).amin(dim=-1)
        some = some | (nearest < length(position - home)).any(dim=-1)
    return some
