"""What an adversary is paid for when it is trained (``train.objective=adversary``): small barriers.

Every robot gets minus its smallest normalised margin in the raw next state,

    r_i = -min of   survivability (E_i - E_min - rho(D_i)) / (E_max - E_min),   overcharge (E_max - E_i) / (E_max - E_min),
                    collision (d_i - Delta) / L,                                certificate (G_i - Delta_G) / L,

with the distance ``d_i`` to the nearest robot, the smallest closest approach ``G_i`` on the way home and the observation's
unit of length L. A certified state has no negative margin: behind a filter that keeps its promise no reward is positive.

Each robot's own minimum makes every robot attack. ``overcharge`` is left out by default: it is the filter's current that
decides it, and a full robot in its slot has no margin left whatever it does, so that docking would be the best attack.
"""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from envs import SurveillanceConfig, keys
from envs.dynamics import pair_indices
from envs.homing import closest_approach, reserve
from safety import SafetyConfig
from safety.certificate import pair_minimum

BARRIERS = ("survivability", "overcharge", "collision", "certificate")


class AdversaryReward:
    """Minus the smallest normalised margin of each robot.

    Args:
        world: the world; a single robot has no margin to another one.
        safety: the filter under attack; the certificate counts only where it is the certified one.
        attack: the barriers that count, of :data:`BARRIERS`.

    Raises:
        ValueError: if no barrier is left.
    """

    def __init__(self, world: SurveillanceConfig, safety: SafetyConfig, attack: Sequence[str]) -> None:
        pairs = ("collision", "certificate") if safety.mode == "certified" else ("collision",)
        offered = ("survivability", "overcharge", *(pairs if world.n_agents > 1 else ()))
        self.attack = [name for name in offered if name in attack]
        if not self.attack:
            raise ValueError(
                f"train.attack={list(attack)} leaves nothing to attack with env.n_agents={world.n_agents}, "
                f"safety.mode={safety.mode}: add one of {', '.join(offered)}."
            )
        self.world = world
        self.geometry = world.homing

    def __call__(self, following: TensorDictBase) -> Tensor:
        """Rewards ``(M, N, 1)`` of next states ``(M,)`` that hold position, energy and slot."""
        position, energy, slot = (following[key] for key in (keys.POSITION, keys.ENERGY, keys.SLOT))
        margins = self.margins(position, energy.squeeze(-1), slot.squeeze(-1))
        return -torch.stack([margins[name] for name in self.attack]).amin(dim=0).unsqueeze(-1)

    def margins(self, position: Tensor, energy: Tensor, slot: Tensor) -> dict[str, Tensor]:
        """Normalised margins ``(M, N)`` of states, by barrier.

        Args:
            position: ``(M, N, d)``, m.
            energy: ``(M, N)``.
            slot: ``(M, N)`` int64.
        """
        world, geometry = self.world, self.geometry
        n, span, length = world.n_agents, world.energy_max - world.energy_min, world.length_scale
        home = torch.tensor(world.slot_positions, dtype=position.dtype, device=position.device)[slot]
        i, j = pair_indices(n, position.device)
        distance = pair_minimum((position[:, i] - position[:, j]).norm(dim=-1), n)
        closest = pair_minimum(closest_approach(position, home, geometry), n)
        needed = reserve((position - home).norm(dim=-1), geometry)
        return {
            "survivability": (energy - world.energy_min - needed) / span,
            "overcharge": (world.energy_max - energy) / span,
            "collision": (distance - world.safety_distance) / length,
            "certificate": (closest - geometry.clearance) / length,
        }
