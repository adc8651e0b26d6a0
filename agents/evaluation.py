"""Deterministic rollouts of a policy in many worlds, measured as they run (nothing is stored but one world's history)."""

import math
from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from envs import SurveillanceEnv, keys
from envs.metrics import ChargeCounter, minimum_distance
from envs.rendering import Trajectory
from safety.statistics import FilterStatistics

RECORD_LIMIT = 2000  # samples of the recorded world by default; longer rollouts keep every n-th


def rollout_steps(horizon: int) -> int:
    """Length of an evaluation that gives none: one episode, or 1000 steps where episodes do not end."""
    return horizon or 1000


@torch.no_grad()
def evaluate_policy(
    env: SurveillanceEnv,
    policy: TensorDictModuleBase,
    steps: int,
    *,
    record: bool = False,
    samples: int = RECORD_LIMIT,
    restart: bool = False,
    check: Callable[[TensorDictBase, Tensor], None] | None = None,
) -> tuple[dict, dict, Trajectory | None]:
    """Roll a filtered policy out from fresh start states; a world counts until it terminates (a time limit does not end it).

    Args:
        env: the worlds; reset here.
        policy: writes ("agents", "action") and the filter's diagnostics.
        steps: length of the rollout.
        record: keep the history of the first world.
        samples: and this many samples of it at most, evenly spread; about 1 kB each (more with a moving density).
        restart: draw a terminated world anew and go on counting in it.
        check: called with every transition and the worlds that count, ``(*B, 1)`` bool, such as
            :func:`agents.incident.check_violations`.

    Returns:
        Metrics (the block ``eval`` of summary.json), the filter's statistics and the history, if recorded.
    """
    config = env.config
    td = env.reset()
    alive = torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    total = {name: torch.zeros((), dtype=torch.float64, device=env.device) for name in ("cost", "reward", "worlds")}
    violations = {kind: torch.zeros((), dtype=torch.int64, device=env.device) for kind in keys.VIOLATION_KINDS}
    energy_margin = distance_margin = torch.full((), math.inf, dtype=config.torch_dtype, device=env.device)
    charges = ChargeCounter(td[keys.ENERGY].squeeze(-1), config)
    statistics = FilterStatistics(config.max_speed)
    restarts = torch.zeros((), dtype=torch.int64, device=env.device)
    history = _History(env, every=math.ceil(steps / samples)) if record else None
    for k in range(steps):
        td = env.step(policy(td))
        following = td["next"]
        energy, next_energy = td[keys.ENERGY].squeeze(-1), following[keys.ENERGY].squeeze(-1)
        total["worlds"] += alive.sum()
        total["cost"] += torch.where(alive, following[keys.COVERAGE_COST], 0).sum(dtype=torch.float64)
        total["reward"] += torch.where(alive, following[keys.REWARD].mean(dim=-2), 0).sum(dtype=torch.float64)
        for kind in violations:
            violations[kind] += (following[(*keys.VIOLATION, kind)].squeeze(-1) & alive).sum()
        margin = torch.minimum(next_energy - config.energy_min, config.energy_max - next_energy)
        energy_margin = torch.minimum(energy_margin, torch.where(alive, margin, math.inf).min())
        gap = minimum_distance(td[keys.POSITION], following[keys.POSITION]) - config.safety_distance
        distance_margin = torch.minimum(distance_margin, torch.where(alive.squeeze(-1), gap, math.inf).min())
        charges.update(energy, next_energy, alive)
        statistics.update(td, alive)
        if history is not None and alive[0]:
            history.add(k, td)
        if check is not None:
            check(td, alive)
        ended, td = following["terminated"], step_mdp(td)
        if restart:
            restarts += (ended & alive).sum()
            if ended.any():
                td = env.reset(td.set("_reset", ended))
                charges.restart(td[keys.ENERGY].squeeze(-1), ended)
        else:
            alive = alive & ~ended
    metrics = {
        "coverage_cost": _finite(total["cost"] / total["worlds"].clamp_min(1)),
        "episode_reward": _finite(total["reward"] / env.batch_size.numel()),
        "violations": {kind: int(count) for kind, count in violations.items()},
        "charges_per_robot": float(charges.count.to(torch.float64).mean()),
        "min_energy_margin": _finite(energy_margin),
        "min_distance_margin": _finite(distance_margin),
        "robot_steps": int(total["worlds"]) * config.n_agents,
        "terminated_worlds": int(restarts) if restart else int((~alive).sum()),
    }
    return metrics, statistics.summary(), None if history is None else history.trajectory()


def evaluation_scalars(metrics: dict) -> dict[str, float]:
    """The numbers of :func:`evaluate_policy`'s metrics by TensorBoard tag."""
    scalars: dict[str, float] = {
        f"eval/{name}": value for name, value in metrics.items() if isinstance(value, int | float)
    }
    return scalars | {f"eval/violations_{kind}": count for kind, count in metrics["violations"].items()}


def _finite(value: Tensor) -> float | None:
    """None (JSON null) where there is nothing to measure: one robot's distance, the cost of an unfiltered NaN action."""
    return float(value) if math.isfinite(value) else None


class _History:
    """History of the first world, every ``every``-th step."""

    def __init__(self, env: SurveillanceEnv, every: int) -> None:
        self.env, self.every = env, every
        self.samples: dict[str, list[np.ndarray]] = {
            name: [] for name in ("position", "energy", "charging", "slot", "density", "coverage_cost")
        }

    def add(self, k: int, td) -> None:
        """Take in transition k (its next state)."""
        if k % self.every:
            return
        following, density = td["next"], self.env.density
        params = following.get(keys.DENSITY, None)
        weights = density.weights(following[keys.POSITION].new_zeros(1, 0) if params is None else params[:1])
        rows = {
            "position": following[keys.POSITION][0],
            "energy": following[keys.ENERGY][0, :, 0],
            "charging": (following[keys.ENERGY] > td[keys.ENERGY])[0, :, 0],
            "slot": following[keys.SLOT][0, :, 0],
            "density": weights.reshape(-1),
            "coverage_cost": following[keys.COVERAGE_COST][0, 0],
        }
        for name, row in rows.items():
            if name != "density" or density.n_params or not self.samples["density"]:
                self.samples[name].append(row.cpu().numpy().copy())

    def trajectory(self) -> Trajectory:
        """The history for :mod:`envs.rendering`."""
        env, config = self.env, self.env.config
        arrays = {name: np.stack(rows) for name, rows in self.samples.items()}
        return Trajectory(
            **arrays,
            points=env.density.points.cpu().numpy(),
            stations=env.stations.cpu().numpy(),
            slots=env.slots.cpu().numpy(),
            arena=env.bounds.cpu().numpy(),
            energy_min=config.energy_min,
            energy_max=config.energy_max,
            charge_radius=config.break_even_radius,
            safety_distance=config.safety_distance,
            dt=config.dt * self.every,
        )
