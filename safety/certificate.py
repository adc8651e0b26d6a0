"""The certified set: rows that keep its quadratic programs feasible, and the shield that keeps every state inside it.

A state is certified (:func:`envs.homing.certified_parts`) when "everybody drives home from here" runs no robot empty
and brings no two robots closer than ``Delta_G``. That set C is invariant under the joint backup motion, whatever the
number of robots, so it offers what the set ``{h_c, h_o, h_s >= 0}`` does not: an admissible joint action at each of its
states.

* :func:`anchors` picks such an action, as little of it as the state demands, and :func:`certified_rows` centres each
  robot's share of the pairwise constraints on it, so that every robot's own program is feasible.
* :func:`shield` steps the world with the programs' actions, checks the very state that the environment will realise
  and replaces failing actions by hold, then by driving home. Invariance rests on it alone: neither on the rows nor on
  the solver.

Theorems, proofs and their limits: docs/safety.md. Flat batches ``(M, N, ..)`` throughout.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from envs.dynamics import other_indices, pair_indices
from envs.homing import (
    ClosestMoment,
    HomingGeometry,
    certified_pairs,
    certified_robots,
    closest_approach,
    closest_moment,
    homing_velocity,
)
from safety.config import Gains

HOLD, HOMING = 1, 2  # levels above 0, the quadratic program


class Rows(NamedTuple):
    """Constraints ``G u <= h`` of every robot's own program, and the action they are centred on."""

    G: Tensor
    """``(M, N, m, d)``."""
    h: Tensor
    """``(M, N, m)``, +inf for no constraint."""
    anchor: Tensor
    """Admissible joint action ``(M, N, d)``, m/s."""
    closest: Tensor
    """``G_ij (M, P)``, m."""


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
    moment = closest_moment(position, slot_position, geometry)
    return moment.distance, *_gradients(moment, position, slot_position)


def _gradients(moment: ClosestMoment, position: Tensor, slot_position: Tensor) -> tuple[Tensor, Tensor]:
    pairs = pair_indices(position.shape[-2], position.device)
    offset = position - slot_position
    direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    normal = moment.relative / moment.distance.clamp_min(1e-30).unsqueeze(-1)
    sides = []
    for robot, share, slope, sign in zip(pairs, moment.share, moment.slope, (1, -1), strict=True):
        e = direction[..., robot, :]
        along = ((slope - share) * (e * normal).sum(-1)).unsqueeze(-1)
        sides.append(sign * (share.unsqueeze(-1) * normal + along * e))
    return sides[0], sides[1]


def anchors(
    chord_normal: Tensor,
    chord_bound: Tensor,
    position: Tensor,
    slot_position: Tensor,
    pair_normals: Tensor,
    pair_slack: Tensor,
    geometry: HomingGeometry,
    max_speed: float,
) -> tuple[Tensor, Tensor]:
    """Joint action that satisfies all rows on C, and what it leaves of the pairs' slack.

    A robot whose survivability row excludes standing still is critical: it drives home, at least as fast as the row
    demands. The others stand. While a pair's slack is negative, both of its robots drive home; two robots that both
    do so keep their slack by the certificate.

    Args:
        chord_normal: ``(M, N, d)``, survivability row's normal.
        chord_bound: ``(M, N)``, its bound.
        position: ``(M, N, d)``, m.
        slot_position: ``(M, N, d)``, m.
        pair_normals: ``(M, K, 2, P, d)``: row k of pair p is ``normals[k, 0] . u_i + normals[k, 1] . u_j <= slack[k]``.
        pair_slack: ``(M, K, P)``, slack of both standing still.
        geometry: constants of the backup motion.
        max_speed: m/s.

    Returns:
        Anchor ``(M, N, d)`` m/s and the slack it leaves ``(M, K, P)``.
    """
    anchor, slack = torch.zeros_like(position), pair_slack.clone()
    todo = (chord_bound < 0).any(dim=-1).nonzero().squeeze(-1)  # elsewhere all may stand: their slack is not negative
    if not len(todo):
        return anchor, slack
    n = position.shape[1]
    i, j = pair_indices(n, position.device)
    home = homing_velocity(position[todo], slot_position[todo], geometry)
    length = chord_normal[todo].norm(dim=-1)
    critical = chord_bound[todo] < 0
    # a hair more than the least speed, as the row is met with equality; only limited where C has been left
    least = (-chord_bound[todo] / length.clamp_min(1e-30) * (1 + 1e-6)).clamp(0, max_speed)
    speed = torch.maximum(home.norm(dim=-1), least)
    fast = -chord_normal[todo] / length.clamp_min(1e-30).unsqueeze(-1) * speed.unsqueeze(-1)
    homing, moving = torch.where(critical.unsqueeze(-1), fast, home), critical
    normals, standing = pair_normals[todo], pair_slack[todo]
    for _ in range(n + 1):
        chosen = torch.where(moving.unsqueeze(-1), homing, 0.0)
        left = standing - _pair_use(normals, chosen, i, j)
        tight = (left < 0).any(dim=1) & ~(moving[:, i] & moving[:, j])
        if not tight.any():
            break
        moving = moving | _either(tight, n, i, j)
    anchor[todo], slack[todo] = chosen, left
    return anchor, slack


def certified_rows(
    position: Tensor,
    slot_position: Tensor,
    chord_normal: Tensor,
    chord_bound: Tensor,
    bounds: Tensor,
    geometry: HomingGeometry,
    gains: Gains,
    *,
    safety_distance: float,
    max_speed: float,
    anchored: bool = True,
) -> Rows:
    """Rows of every robot's program: survivability, collision and certificate shared around the anchor, arena.

    Collision (exact over the whole step, as ``h_s`` is convex along it): ``h_s + dt 2 q . (u_i - u_j) >= (1 - g_s) h_s``;
    certificate (linearised): ``G + dt grad G . u >= Delta_G + eps + (1 - g_G)(G - Delta_G - eps)``. Robot i takes half of
    what the anchor leaves of each.

    Args:
        position: ``(M, N, d)``, m.
        slot_position: ``(M, N, d)``, m.
        chord_normal: ``(M, N, d)`` and
        chord_bound: ``(M, N)``, the survivability row (:func:`safety.barriers.sampled_energy_row`).
        bounds: ``(d, 2)``, the arena, m.
        geometry: constants of the backup motion.
        gains: class-K gains.
        safety_distance: ``Delta``, m.
        max_speed: m/s.
        anchored: False centres the rows on standing still, the literature's split by halves (may be infeasible).

    Returns:
        ``m = 1 + 2 (N - 1) + 2 d`` rows per robot.
    """
    (_, n, d), device = position.shape, position.device
    i, j = pair_indices(n, device)
    gap = position[:, i] - position[:, j]
    moment = closest_moment(position, slot_position, geometry)
    first, second = _gradients(moment, position, slot_position)
    barrier = gap.square().sum(-1) - safety_distance**2
    spare = (moment.distance - geometry.clearance - geometry.eps_distance).clamp_min(0)
    pair_slack = torch.stack([gains.collision * barrier, gains.certificate * spare], dim=1)
    pair_normals = torch.stack([torch.stack([-2 * gap, 2 * gap], 1), torch.stack([-first, -second], 1)], dim=1)
    if anchored:
        layout = (chord_normal, chord_bound, position, slot_position)
        anchor, slack = anchors(*layout, pair_normals, pair_slack, geometry, max_speed)
    else:
        anchor, slack = torch.zeros_like(position), pair_slack
    # robot i's side of its N - 1 pairs: side 0 of pair (i, j), side 1 of pair (j, i)
    others = other_indices(n, device)
    robots = torch.arange(n, device=device).unsqueeze(-1)
    number = torch.zeros(n, n, dtype=torch.int64, device=device)
    number[i, j] = number[j, i] = torch.arange(len(i), device=device)
    pair = number[robots, others]
    side = (robots > others).to(torch.int64) * len(i) + pair
    normals = pair_normals.flatten(2, 3)[:, :, side]  # (M, 2, N, N - 1, d)
    shares = slack.clamp_min(0)[:, :, pair] / 2 + (normals * anchor[:, None, :, None]).sum(-1)
    walls = torch.cat(
        [torch.eye(d, dtype=position.dtype, device=device), -torch.eye(d, dtype=position.dtype, device=device)]
    )
    room = torch.cat([bounds[:, 1] - position, position - bounds[:, 0]], dim=-1).clamp_min(0) / geometry.dt
    return Rows(
        G=torch.cat([chord_normal.unsqueeze(2), normals[:, 0], normals[:, 1], walls.expand(*room.shape, d)], dim=2),
        h=torch.cat([chord_bound.unsqueeze(-1), shares[:, 0], shares[:, 1], room], dim=-1),
        anchor=anchor,
        closest=moment.distance,
    )


def outside(
    position: Tensor, energy: Tensor, slot_position: Tensor, closest: Tensor, geometry: HomingGeometry, bounds: Tensor
) -> Tensor:
    """Robots whose own part of the certified set, or a pair's that they belong to, does not hold: ``(M, N)`` bool."""
    robots = certified_robots(position, energy, slot_position, geometry, bounds, margins=0)
    pairs = certified_pairs(closest, geometry, margins=0)
    n = position.shape[1]
    return ~robots | _either(~pairs, n, *pair_indices(n, position.device))


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
) -> tuple[Tensor, Tensor, Tensor]:
    """Raise actions from the program's to hold to driving home until the next state is certified.

    Each round steps the world with the present actions. A robot whose certificate fails is raised one level; of a pair
    whose certificate fails the robot with the lower level is, both if they are equal. Levels only rise, so the loop
    ends within ``2 N + 1`` rounds; from a certified state with every robot driving home all certificates hold, so it
    ends with all of them true. ``G`` changes by no more than the two robots move (it is 1-Lipschitz in each position),
    so pairs with ``G >= Delta_G + 2 max_speed dt`` need not be looked at.

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

    Returns:
        Action ``(M, N, d)`` m/s, level ``(M, N)`` int64 and rounds needed ``(M,)`` int64.
    """
    n = position.shape[1]
    pairs = torch.stack(pair_indices(n, position.device), dim=-1)
    level, rounds = level.clone(), torch.zeros_like(level[:, 0])
    home = homing_velocity(position, slot_position, geometry)
    chosen = _by_level(action, home, level)
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
    i, j = pair_indices(n, pairs.device)
    square = pairs.new_full((len(pairs), n, n), torch.inf)
    square[:, i, j] = square[:, j, i] = pairs
    return square.amin(dim=-1)


def _by_level(action: Tensor, home: Tensor, level: Tensor) -> Tensor:
    level = level.unsqueeze(-1)
    return torch.where(level == 0, action, torch.where(level == HOMING, home, 0.0))


def _pair_use(normals: Tensor, action: Tensor, i: Tensor, j: Tensor) -> Tensor:
    """Left side of the pairs' rows at a joint action: ``(M, K, 2, P, d), (M, N, d) -> (M, K, P)``."""
    both = torch.stack([action[:, i], action[:, j]], dim=1).unsqueeze(1)
    return (normals * both).sum((2, 4))


def _either(pairs: Tensor, n: int, *members: Tensor) -> Tensor:
    """Robots that are a ``member`` of a marked pair: ``(M, P)`` bool to ``(M, N)`` bool."""
    marked = torch.zeros(len(pairs), n, dtype=torch.int64, device=pairs.device)
    for member in members:
        marked = marked.index_add(1, member, pairs.to(torch.int64))
    return marked > 0
