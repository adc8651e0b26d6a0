"""Adversaries: nominal policies that try to empty batteries, to overcharge them and to make robots collide.

What a filter promises holds for any nominal action, so it is tried against these. They see the whole state, know the
homing certificate, ignore the batteries and mostly the walls, and may ask for more than ``max_speed`` or for NaN.
"""

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agents.base import Controller
from envs import SurveillanceConfig
from envs.dynamics import limit_speed, pair_indices
from safety.certificate import closest_approach_gradient

TINY = 1e-30  # below it a length is 0
RENEWAL = 0.02  # probability per step that an adversary changes its mind


def unit(vector: Tensor) -> Tensor:
    """Directions of vectors ``(.., d)``; 0 for 0."""
    return vector / vector.norm(dim=-1, keepdim=True).clamp_min(TINY)


class Random(Controller):
    """Uniform in the speed ball, drawn anew each step."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        direction = unit(self.normal(position, *position.shape))
        share = self.uniform(position, *position.shape[:-1], 1) ** (1 / position.shape[-1])
        return self.world.max_speed * share * direction


class OrnsteinUhlenbeck(Controller):
    """Coloured noise, correlated over about 30 steps, cut to the speed ball: it saturates most of the time."""

    correlation = 30.0
    """Steps after which the correlation has fallen to 1/e."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        memory = self.memory(position, lambda: {"noise": self.normal(position, *position.shape)})
        keep = math.exp(-1 / self.correlation)
        fresh = self.normal(position, *position.shape)
        memory["noise"] = keep * memory["noise"] + math.sqrt(1 - keep**2) * fresh
        return limit_speed(self.world.max_speed * memory["noise"], self.world.max_speed)


class Flee(Controller):
    """Full speed straight away from the own slot, sliding along the walls into the farthest reachable corner."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, slot_position = self.places(tensordict)
        return self.world.max_speed * self.away(position, slot_position)

    def away(self, position: Tensor, slot_position: Tensor) -> Tensor:
        """Directions ``(*B, N, d)`` away from the slot along the walls; a docked robot makes for the farthest corner."""
        low, high = self.arena(position).unbind(-1)
        step = self.world.max_speed * self.world.dt
        corner = torch.where(slot_position > (low + high) / 2, low, high)
        # the corner's share is negligible, but for a robot in its slot or at the wall straight opposite
        direction = unit(position - slot_position + 1e-3 * step * unit(corner - position))
        following = position + step * direction
        leaves = ((following > high) & (direction > 0)) | ((following < low) & (direction < 0))
        slide = torch.where(leaves, 0.0, direction)
        stuck = slide.norm(dim=-1, keepdim=True) < 1e-7  # in the corner: lean on it
        return torch.where(stuck, direction, unit(slide))


class Gather(Controller):
    """All robots of a world at full speed to one point; the point changes now and then."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        worlds = (*position.shape[:-2], 1)
        memory = self.memory(position, lambda: {"point": self.points(position, *worlds)})
        renew = self.uniform(position, *worlds, 1) < RENEWAL
        memory["point"] = torch.where(renew, self.points(position, *worlds), memory["point"])
        return self.world.max_speed * unit(memory["point"] - position)


class Swap(Controller):
    """Robots exchange places straight through each other, again and again.

    In every world either pairs drawn at random exchange their positions, or all robots drive to the point opposite
    through the arena's middle (so does the odd robot out). All there, or after a random time, the next exchange starts.
    """

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        goals = self._goals(position)
        memory = self.memory(position, lambda: {"goal": goals})
        step = self.world.max_speed * self.world.dt
        way = (memory["goal"] - position).norm(dim=-1).amax(dim=-1)
        renew = (way <= 2 * step) | (self.uniform(position, *position.shape[:-2]) < RENEWAL)
        memory["goal"] = torch.where(renew[..., None, None], goals, memory["goal"])
        return self.world.max_speed * unit(memory["goal"] - position)

    def _goals(self, position: Tensor) -> Tensor:
        *worlds, n, d = position.shape
        order = self.uniform(position, *worlds, n).argsort(dim=-1)
        # places 2 k and 2 k + 1 of the order are partners, an odd one out keeps its own
        places = torch.arange(n, device=position.device)
        beside = torch.where((places ^ 1) < n, places ^ 1, places)
        partner = torch.empty_like(order).scatter(-1, order, order[..., beside])
        exchanged = position.gather(-2, partner.unsqueeze(-1).expand(*worlds, n, d))
        through = (self.uniform(position, *worlds, 1) < 0.5) | (partner == places)
        return torch.where(through.unsqueeze(-1), self.arena(position).sum(-1) - position, exchanged)


class Chatter(Controller):
    """Full speed, reversed every step (half of the robots) or at random, sometimes at right angles.

    One action in ten asks for a thousand times the speed limit.
    """

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        robots = (*position.shape[:-1], 1)
        memory = self.memory(position, lambda: self._start(position))
        turn, reverse, push = (self.uniform(position, *robots) for _ in range(3))
        heading = memory["heading"]
        other = self.normal(position, *position.shape)
        across = unit(other - (other * heading).sum(-1, keepdim=True) * heading)
        heading = torch.where(reverse < memory["reversal"], -heading, heading)
        memory["heading"] = torch.where(turn < 0.1, across, heading)
        return self.world.max_speed * torch.where(push < 0.1, 1e3, 1.0) * memory["heading"]

    def _start(self, position: Tensor) -> dict[str, Tensor]:
        every = self.uniform(position, *position.shape[:-1], 1) < 0.5
        reversal = torch.where(every, 1.0, 0.5).to(position.dtype)
        return {"heading": unit(self.normal(position, *position.shape)), "reversal": reversal}


class Block(Flee):
    """Sit in another robot's dock, or stand on its way there. A single robot flees."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, slot_position = self.places(tensordict)
        if position.shape[-2] == 1:
            return super().act(tensordict)
        fresh = self._start(position)
        memory = self.memory(position, lambda: fresh)
        renew = self.uniform(position, *position.shape[:-1]) < RENEWAL
        for name, value in fresh.items():
            memory[name] = torch.where(renew, value, memory[name])
        victim = memory["victim"].unsqueeze(-1).expand_as(position)
        theirs, dock = position.gather(-2, victim), slot_position.gather(-2, victim)
        offset = dock + memory["share"].unsqueeze(-1) * (theirs - dock) - position
        return limit_speed(offset / self.world.dt, self.world.max_speed)

    def _start(self, position: Tensor) -> dict[str, Tensor]:
        """Another robot as victim ``(*B, N)`` and the place to sit, as share of its way home: half of them in the dock."""
        robots = position.shape[:-1]
        n = robots[-1]
        ahead = 1 + (self.uniform(position, *robots) * (n - 1)).long().clamp_max(n - 2)
        share = (2 * self.uniform(position, *robots) - 1).clamp_min(0)
        return {"victim": (torch.arange(n, device=position.device) + ahead) % n, "share": share}


class Tangential(Flee):
    """Full speed at right angles to the direction of the own slot.

    Keeping the distance in continuous time, in sampled time it gains ``(max_speed dt)^2 / (2 D)`` a step: the worst case
    of the survivability row. The sense (in 3-D the axis) is drawn per robot and changes now and then.
    """

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, slot_position = self.places(tensordict)
        fresh = self._turns(position)
        memory = self.memory(position, lambda: {"turn": fresh})
        renew = self.uniform(position, *position.shape[:-1], 1, 1) < RENEWAL
        memory["turn"] = torch.where(renew, fresh, memory["turn"])
        offset = position - slot_position
        docked = offset.norm(dim=-1, keepdim=True) < 1e-9
        radial = torch.where(docked, self.away(position, slot_position), unit(offset))
        return self.world.max_speed * unit((memory["turn"] @ radial.unsqueeze(-1)).squeeze(-1))

    def _turns(self, position: Tensor) -> Tensor:
        """Random skew-symmetric matrices ``(*B, N, d, d)``: what they map is at right angles to what they are given."""
        matrix = self.normal(position, *position.shape, position.shape[-1])
        return matrix - matrix.transpose(-1, -2)


class Chase(Flee):
    """Full speed at the nearest other robot. A single robot flees."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, slot_position = self.places(tensordict)
        return self.world.max_speed * self.pursuit(position, slot_position)

    def pursuit(self, position: Tensor, slot_position: Tensor) -> Tensor:
        """Directions ``(*B, N, d)`` to the nearest robot."""
        n = position.shape[-2]
        if n == 1:
            return self.away(position, slot_position)
        gap = position.unsqueeze(-3) - position.unsqueeze(-2)  # other minus own: (*B, N, N, d)
        itself = torch.eye(n, dtype=torch.bool, device=position.device)
        nearest = torch.where(itself, torch.inf, gap.square().sum(-1)).argmin(dim=-1)
        return unit(position.gather(-2, nearest.unsqueeze(-1).expand_as(position)) - position)


class CertificateDescent(Chase):
    """Steepest descent of the homing certificate: minus the gradient of the smallest ``G_ij`` that the robot can lower.

    Pairs whose closest approach does not depend on the robot's position (it comes once the robot is home) are left out;
    a robot without any other chases its neighbour.
    """

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, slot_position = self.places(tensordict)
        n, pursuit = position.shape[-2], self.pursuit(position, slot_position)
        if n == 1:
            return self.world.max_speed * pursuit
        gap, first, second = closest_approach_gradient(position, slot_position, self.geometry)
        i, j = pair_indices(n, position.device)
        slope = position.new_zeros(*position.shape[:-1], n, position.shape[-1])  # (*B, N, N, d)
        slope[..., i, j, :], slope[..., j, i, :] = first, second
        least = position.new_full((*position.shape[:-1], n), torch.inf)
        least[..., i, j] = least[..., j, i] = gap
        least = torch.where(slope.norm(dim=-1) > 1e-4, least, torch.inf)
        smallest, other = least.min(dim=-1, keepdim=True)
        descent = -slope.gather(-2, other.unsqueeze(-1).expand_as(position.unsqueeze(-2))).squeeze(-2)
        return self.world.max_speed * torch.where(smallest.isfinite(), unit(descent), pursuit)


class Mixture(Controller):
    """Every robot of every world follows one of the other adversaries, drawn anew now and then.

    Args:
        world: the world.
        seed: seed of the choice and, shifted, of the adversaries.
    """

    def __init__(self, world: SurveillanceConfig, seed: int = 0) -> None:
        super().__init__(world, seed)
        self.members = torch.nn.ModuleList(kind(world, seed + 1 + k) for k, kind in enumerate(MEMBERS.values()))

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position, _ = self.places(tensordict)
        fresh = (
            (self.uniform(position, *position.shape[:-1]) * len(self.members)).long().clamp_max(len(self.members) - 1)
        )
        memory = self.memory(position, lambda: {"kind": fresh})
        renew = self.uniform(position, *position.shape[:-1]) < RENEWAL
        memory["kind"] = torch.where(renew, fresh, memory["kind"])
        actions = torch.stack([member.act(tensordict) for member in self.members])  # (K, *B, N, d)
        return actions.gather(0, memory["kind"][None, ..., None].expand_as(actions[:1])).squeeze(0)


class NotANumber(Random):
    """Random, but one robot in four gets NaN, +inf, -inf or 1e30, in one component or in all of them."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        action = super().act(tensordict)
        robots, d = (*action.shape[:-1], 1), action.shape[-1]
        values = torch.tensor([math.nan, math.inf, -math.inf, 1e30], dtype=action.dtype, device=action.device)
        value = values[(self.uniform(action, *robots) * len(values)).long().clamp_max(len(values) - 1)]
        axis = (self.uniform(action, *robots) * d).long()
        hit = (torch.arange(d, device=action.device) == axis) | (self.uniform(action, *robots) < 0.5)
        return torch.where(hit & (self.uniform(action, *robots) < 0.25), value, action)


MEMBERS: dict[str, type[Controller]] = {
    "random": Random,
    "ou": OrnsteinUhlenbeck,
    "flee": Flee,
    "gather": Gather,
    "swap": Swap,
    "chatter": Chatter,
    "block": Block,
    "tangential": Tangential,
    "chase": Chase,
    "certificate_descent": CertificateDescent,
}

ADVERSARIES: dict[str, type[Controller]] = {**MEMBERS, "mixture": Mixture, "nan": NotANumber}
