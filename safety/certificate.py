"""The certified set: rows that keep its quadratic programs feasible, and the shield that keeps every state inside it.

A state is certified (:func:`envs.homing.certified_parts`) when "everybody drives home from here" runs no robot empty
and brings no two robots closer than ``Delta_G``. That set C is invariant under the joint backup motion, whatever the
number of robots, so it offers what the set ``{h_c, h_o, h_s >= 0}`` does not: an admissible joint action at each of its
states.

* :func:`anchors` picks such an action, as little of it as the state demands; the rows of :mod:`safety.certified_rows`
  are centred on it, so that every robot's own program is feasible.
* :func:`shield` steps the world with the programs' actions, checks the very state that the environment will realise
  and replaces failing actions by hold, then by driving home. Invariance rests on it alone: neither on the rows nor on
  the solver.

Theorems, proofs and their limits: docs/safety.md. Flat batches ``(M, N, ..)`` throughout.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from envs.dynamics import length, limit_speed, own_pairs, pair_indices, take
from envs.homing import (
    TINY,
    ClosestMoments,
    HomingGeometry,
    certified_pairs,
    certified_parts,
    certified_robots,
    closest_approach,
    closest_moments,
    homing_velocity,
)

HOLD, HOMING = 1, 2  # levels above 0, the quadratic program


def closest_approach_gradient(
    position: Tensor, slot_position: Tensor, geometry: HomingGeometry
) -> tuple[Tensor, Tensor, Tensor]:
    """Closest approach of two homing robots and its gradient with respect to their positions.

    At the minimiser ``t*`` with ``n = (xi_i - xi_j) / G``, ``r = l / D``, ``l' = dl / dD`` and ``e`` the direction from
    the slot: ``dG/dp_i = r n + (l' - r)(e . n) e`` (Danskin); j's has the opposite sign.

    Args:
        position: ``(*B, N, d)``, m.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of the backup motion.

    Returns:
        ``G (*B, P)`` m, ``dG/dp_i`` and ``dG/dp_j`` ``(*B, P, d)``; pairs in ``torch.triu_indices`` order.
    """
    moments = closest_moments(position, slot_position, geometry)
    least, index = moments.distance.min(dim=0, keepdim=True)
    pair = torch.stack(pair_indices(position.shape[-2], position.device))
    e, _ = from_slot(position, slot_position)
    e = e.movedim(-1, 0)[..., pair].movedim(-2, 0)  # (2, d, *B, P)
    gradients = pair_gradients(moments, e)
    wide = index[:, None, None].expand(1, *gradients.shape[1:])
    first, second = gradients.gather(0, wide).squeeze(0).movedim(1, -1)
    return least.squeeze(0), first, second


def pair_gradients(moments: ClosestMoments, e: Tensor) -> Tensor:
    """Gradients of the pieces' distances with respect to i's and to j's position.

    Args:
        moments: of the pairs ``...``.
        e: directions of i and j from their slots, ``(2, d, ...)``.

    Returns:
        ``(S, 2, d, ...)``.
    """
    normal = (moments.relative / moments.distance.clamp_min(TINY).unsqueeze(1)).unsqueeze(1)  # (S, 1, d, ...)
    gradient = own_gradient(moments.share, moments.slope, e, normal, 2)
    return torch.stack([gradient[:, 0], -gradient[:, 1]], dim=1)


def own_gradient(share: Tensor, slope: Tensor, e: Tensor, normal: Tensor, dim: int) -> Tensor:
    """``r n + (l' - r)(e . n) e``, components along ``dim`` of ``e`` and ``n``; r and l' have no such dimension."""
    along = (slope - share) * (e * normal).sum(dim)
    return share.unsqueeze(dim) * normal + along.unsqueeze(dim) * e


def from_slot(position: Tensor, slot_position: Tensor) -> tuple[Tensor, Tensor]:
    """Directions ``e (*B, N, d)`` from the slots to the robots, 0 in the slot, and distances ``(*B, N)``, m."""
    offset = position - slot_position
    distance = length(offset)
    return offset / distance.unsqueeze(-1), distance


def anchors(
    chord_normal: Tensor,
    chord_bound: Tensor,
    position: Tensor,
    slot_position: Tensor,
    members: tuple[Tensor, Tensor, Tensor],
    normals: Tensor,
    slack: Tensor,
    geometry: HomingGeometry,
    max_speed: float,
    *,
    fixed_sizes: bool = False,
) -> tuple[Tensor, Tensor]:
    """Joint action that satisfies all rows on C, and what it leaves of the pairs' slack.

    A robot whose survivability row excludes standing still is critical: it drives home, at least as fast as the row
    demands. The others stand. While a pair's slack is negative, both of its robots drive home; what two homing robots
    still lack (in the last partial step, or one driving faster than ``v``) the rows leave to the shield.

    Args:
        chord_normal: ``(M, N, d)``, survivability row's normal.
        chord_bound: ``(M, N)``, its bound.
        position: ``(M, N, d)``, m.
        slot_position: ``(M, N, d)``, m.
        members: world, robot i and robot j of the E pairs that need looking at, ``(E,)`` int64 each.
        normals: ``(K, 2, d, E)``: row k of a pair is ``normals[k, 0] . u_i + normals[k, 1] . u_j <= slack[k]``.
        slack: ``(K, E)``, slack of both standing still.
        geometry: constants of the backup motion.
        max_speed: m/s.
        fixed_sizes: take all rounds that may be needed.

    Returns:
        Anchor ``(M, N, d)`` m/s and the slack it leaves ``(K, E)``.
    """
    world, i, j = members
    home = limit_speed(homing_velocity(position, slot_position, geometry), max_speed)
    size = length(chord_normal)
    critical = chord_bound < 0
    # a hair more than the least speed, as the row is met with equality; only limited where C has been left
    least = (-chord_bound / size * (1 + 1e-6)).clamp(0, max_speed)
    speed = torch.maximum(length(home), least)
    fast = -chord_normal * (speed / size).unsqueeze(-1)
    homing, moving = torch.where(critical.unsqueeze(-1), fast, home), critical
    for _ in range(position.shape[1] + 1):
        chosen = torch.where(moving.unsqueeze(-1), homing, 0.0)
        both = torch.stack([chosen[world, i].mT, chosen[world, j].mT])  # (2, d, E)
        left = slack - (normals * both).sum((1, 2))
        tight = (left < 0).any(dim=0) & ~(moving[world, i] & moving[world, j])
        if not fixed_sizes and not bool(tight.any()):
            break
        robots = (torch.cat([world, world]), torch.cat([i, j]))  # of all pairs, several times each
        pulls = tight.to(slack.dtype).repeat(2)
        moving = moving | (torch.zeros_like(chord_bound).index_put(robots, pulls, accumulate=True) > 0)
    return chosen, left


def outside(
    position: Tensor, energy: Tensor, slot_position: Tensor, closest: Tensor, geometry: HomingGeometry, bounds: Tensor
) -> Tensor:
    """Robots whose own part of the certified set, or a pair's that they belong to, does not hold: ``(M, N)`` bool."""
    robots = certified_robots(position, energy, slot_position, geometry, bounds, margins=0)
    pairs = certified_pairs(closest, geometry, margins=0)
    return ~robots | _either(~pairs, position.shape[1])


def shield(
    step: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    position: Tensor,
    energy: Tensor,
    slot_position: Tensor,
    action: Tensor,
    current: Tensor,
    level: Tensor,
    closest: Tensor,
    geometry: HomingGeometry,
    bounds: Tensor,
    *,
    max_speed: float,
    fixed_sizes: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Raise actions from the program's to hold to driving home until the next state is certified.

    Each round steps the world with the present actions. A robot whose certificate fails is raised one level; of a pair
    whose certificate fails the robot with the lower level is, both if they are equal. Levels only rise, so the loop
    ends within ``2 N + 1`` rounds; from a certified state with every robot driving home all certificates hold, so it
    ends with all of them true. ``G`` changes by no more than the two robots move (it is 1-Lipschitz in each position),
    so pairs with ``G >= Delta_G + eps + 2 max_speed dt`` need not be looked at.

    With ``fixed_sizes`` there is one round for all worlds, and where a certificate fails all robots of that world drive home:
    the last of the other way's rounds at once.

    Args:
        step: the environment's own transition, ``(position, energy, velocity, current) -> (position, energy)``.
        position: ``(M, N, d)``, m.
        energy: ``(M, N)``.
        slot_position: ``(M, N, d)``, m.
        action: ``(M, N, d)``, m/s, the programs' solutions, in the speed ball.
        current: ``(M, N)``, accepted current, the same at every level.
        level: ``(M, N)`` int64, levels to start from.
        closest: ``G (M, P)`` of the present state, m.
        geometry: constants of the backup motion.
        bounds: ``(d, 2)``, the arena, m.
        max_speed: m/s.
        fixed_sizes: see above.

    Returns:
        Action ``(M, N, d)`` m/s, level ``(M, N)`` int64 and rounds needed ``(M,)`` int64.
    """
    n = position.shape[1]
    pairs = torch.stack(pair_indices(n, position.device), dim=-1)
    level, rounds = level.clone(), torch.zeros_like(level[:, 0])
    # as the environment will cut it, far outside the arena in the logarithmic family
    home = limit_speed(homing_velocity(position, slot_position, geometry), max_speed)
    home = torch.where(home.isfinite(), home, 0.0)
    chosen = _by_level(action, home, level)
    if fixed_sizes:
        after, next_energy = step(position, energy, chosen.detach(), current)
        robots, near = certified_parts(after, next_energy, slot_position, geometry, bounds, margins=1)
        far = level == HOMING  # drive home already: outside the set, where nothing is promised
        kept = (robots | far).all(dim=-1, keepdim=True) & (near | far[:, pairs].all(dim=-1)).all(dim=-1, keepdim=True)
        level = torch.where(kept, level, HOMING)
        return _by_level(action, home, level), level, rounds + 1
    reach = geometry.clearance + geometry.eps_distance + 2 * max_speed * geometry.dt
    worlds, near = (~(closest >= reach)).nonzero(as_tuple=True)
    members = pairs[near]  # (K, 2)
    todo = torch.arange(len(position), device=position.device)
    for _ in range(2 * n + 1):
        some = slice(None) if len(todo) == len(position) else todo  # no copies while nothing has been set aside
        now, slots = level[some], slot_position[some]
        after, next_energy = step(position[some], energy[some], chosen[some].detach(), current[some])
        raised = (~certified_robots(after, next_energy, slots, geometry, bounds, margins=1)).to(level.dtype)
        pair = (worlds.unsqueeze(-1), members)
        gap = closest_approach(after[pair], slots[pair], geometry)
        lower = now[pair] == now[pair].amin(dim=-1, keepdim=True)
        failing = lower & ~certified_pairs(gap, geometry, margins=1)
        raised.index_put_(pair, failing.to(level.dtype), accumulate=True)
        raised = (raised > 0) & (now < HOMING)
        rounds[some] += 1
        changed = raised.any(dim=-1)
        index = changed.nonzero().squeeze(-1)
        if not len(index):
            break
        todo, now = todo[index], now[index] + raised[index]
        level[todo] = now
        chosen = chosen.index_copy(0, todo, _by_level(action[todo], home[todo], now))
        kept = changed[worlds]
        worlds, members = (changed.cumsum(0) - 1)[worlds[kept]], members[kept]
    return chosen, level, rounds


def pair_minimum(pairs: Tensor, n: int) -> Tensor:
    """Least value of the pairs that a robot belongs to: ``(M, P)`` to ``(M, N)``, +inf for a single robot."""
    if n == 1:
        return pairs.new_full((len(pairs), 1), torch.inf)
    return take(pairs, own_pairs(n, pairs.device)[0]).amin(dim=-1)


def _by_level(action: Tensor, home: Tensor, level: Tensor) -> Tensor:
    level = level.unsqueeze(-1)
    return torch.where(level == 0, action, torch.where(level == HOMING, home, 0.0))


def _either(pairs: Tensor, n: int) -> Tensor:
    """Robots that belong to a marked pair: ``(M, P)`` bool to ``(M, N)`` bool."""
    return take(pairs, own_pairs(n, pairs.device)[0]).any(dim=-1)
