"""The energy-aware task controller: way-points, and home in time. Compares what filters leave of the task."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agents.base import Controller
from envs import SurveillanceConfig, keys


class Patrol(Controller):
    """Every robot drives to its own random way-point at full speed; reached, it counts and the next one is drawn.

    A way-point is reached within ``max(0.05 L, max_speed dt)``, L half the arena's longest side. A robot whose energy
    nears the reserve gives its way-point up (without counting it: it may be out of its range), drives home, stays until
    nearly full and draws another; that hysteresis needs no memory, as a robot inside its slot's charging radius that is
    not full stays. The accepted current is the filter's: without one, leaving a full charger overcharges.

    Args:
        world: the world.
        seed: seed of the way-points.
    """

    def __init__(self, world: SurveillanceConfig, seed: int = 0) -> None:
        super().__init__(world, seed)
        self.arrival = max(0.05 * world.length_scale, world.max_speed * world.dt)
        """Distance at which a way-point counts as reached, m."""

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        position = tensordict[keys.POSITION]
        memory = self.memory(position, lambda: self._start(position))
        home, way_home = self.way_to_charge(tensordict)
        reached = (memory["waypoint"] - position).norm(dim=-1) <= self.arrival
        memory["reached"] = memory["reached"] + (reached & ~home)
        fresh = self.points(position, *position.shape[:-1])
        memory["waypoint"] = torch.where((reached | home).unsqueeze(-1), fresh, memory["waypoint"])
        offset = memory["waypoint"] - position
        out = offset * (self.world.max_speed / offset.norm(dim=-1, keepdim=True).clamp_min(1e-30))
        return torch.where(home.unsqueeze(-1), way_home, out)

    def metrics(self) -> dict[str, float]:
        """``waypoints``: number reached so far, over all robots and worlds."""
        return {"waypoints": float(self._memory["reached"].sum()) if self._memory else 0.0}

    def _start(self, position: Tensor) -> dict[str, Tensor]:
        robots = position.shape[:-1]
        count = torch.zeros(robots, dtype=torch.int64, device=position.device)
        return {"waypoint": self.points(position, *robots), "reached": count}
