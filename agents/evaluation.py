"""Deterministic rollouts of policies in many worlds, measured as they run (nothing is stored but one world's history a seed)."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from envs import SurveillanceEnv, keys
from envs.coverage import powered_coverage_cost
from envs.graphs import graphed
from envs.metrics import Charges, minimum_distance
from envs.rendering import Trajectory
from safety.statistics import FILTER_READS, MARGINS, SUMS, FilterStatistics, filter_numbers

RECORD_LIMIT = 2000  # samples of the recorded world by default; longer rollouts keep every n-th


def rollout_steps(horizon: int) -> int:
    """Length of an evaluation that gives none: one episode, or 1000 steps where episodes do not end."""
    return horizon or 1000


READ: list[NestedKey] = [
    *(keys.POSITION, keys.ENERGY, *FILTER_READS),
    *(("next", *key) for key in (keys.POSITION, keys.ENERGY, keys.REWARD)),
    *(("next", key) for key in (keys.COVERAGE_COST, keys.DENSITY, "terminated")),
    *(("next", *keys.VIOLATION, kind) for kind in keys.VIOLATION_KINDS),
]
"""What is measured of a transition."""
ADDED = ("worlds", "cost", "powered", "reward", *keys.VIOLATION_KINDS, *SUMS)
"""What is summed over the worlds that count and the steps."""
LEAST = ("energy_margin", "distance_margin", "residual", *MARGINS)
"""What the least is kept of."""


class Measured(NamedTuple):
    """Rollouts so far, of the worlds of all seeds."""

    alive: Tensor
    """Worlds that count, ``(B, 1)`` bool."""
    charges: Charges
    """Of all robots."""
    sums: Tensor
    """In the order of ``ADDED``, ``(seeds, n)`` float64."""
    least: Tensor
    """In the order of ``LEAST``, ``(seeds, n)`` float64; "residual" is minus the largest."""


class Evaluation(NamedTuple):
    """What came of the rollout of a seed."""

    metrics: dict
    """The block ``eval`` of summary.json."""
    statistics: dict
    """What the filter did."""
    trajectory: Trajectory | None
    """History of the first world, if recorded."""


class Evaluator:
    """Deterministic rollouts in the worlds of an environment, of a policy per seed of the environment.

    Args:
        env: the worlds. All policies write the same keys.
        cuda_graphs: record the measuring and replay it (:mod:`envs.graphs`).
    """

    def __init__(self, env: SurveillanceEnv, *, cuda_graphs: bool = False) -> None:
        self.env, self.recorded = env, cuda_graphs
        self._measure = graphed(self._measure_tensors, enabled=cuda_graphs)
        self._keys: list[NestedKey] = []

    def __call__(
        self,
        policy: TensorDictModuleBase,
        steps: int,
        *,
        seeds: Sequence[int] = (),
        record: bool = False,
        samples: int = RECORD_LIMIT,
        restart: bool = False,
        check: Callable[[TensorDictBase, Tensor], None] | None = None,
    ) -> list[Evaluation]:
        """Roll a filtered policy out from fresh start states; a world counts until it terminates (a time limit does not end it).

        Args:
            policy: writes ("agents", "action") and the filter's diagnostics; of several learners if the worlds have several
                seeds, each in its block (:mod:`envs.blocks`).
            steps: length of the rollout.
            seeds: of the start states, one per block; if not given, the streams go on.
            record: keep the history of each block's first world.
            samples: and this many samples of it at most, evenly spread; about 1 kB each (more with a moving density).
            restart: draw a terminated world anew and go on counting in it.
            check: called with every transition and the worlds that count, ``(*B, 1)`` bool, such as
                :func:`agents.incident.check_violations`.

        Returns:
            An evaluation per block.
        """
        env = self.env
        for block, seed in zip(env.blocks, seeds, strict=bool(seeds)):
            block.generator.manual_seed(seed)
        histories = []
        if record:
            histories = [_History(env, block.worlds.start, math.ceil(steps / samples)) for block in env.blocks]
        with env.without_gradients():
            measured, restarts = self._roll_out(policy, steps, histories, check, restart=restart)
            found = self._numbers(measured)
        if restart:
            for (metrics, _), count in zip(found, restarts.tolist(), strict=True):
                metrics["terminated_worlds"] = count
        trajectories = [history.trajectory() for history in histories] or [None] * len(found)
        return [Evaluation(*own, trajectory) for own, trajectory in zip(found, trajectories, strict=True)]

    def _roll_out(
        self,
        policy: TensorDictModuleBase,
        steps: int,
        histories: Sequence["_History"],
        check: Callable[[TensorDictBase, Tensor], None] | None,
        *,
        restart: bool,
    ) -> tuple[Measured, Tensor]:
        """What was measured, and how many worlds of each block were drawn anew, ``(seeds,)``."""
        env = self.env
        td = env.reset()
        factory = {"dtype": torch.float64, "device": env.device}
        measured = Measured(
            torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device),
            Charges.none(td[keys.ENERGY].squeeze(-1)),
            torch.zeros(env.n_blocks, len(ADDED), **factory),
            torch.full((env.n_blocks, len(LEAST)), math.inf, **factory),
        )
        restarts = torch.zeros(env.n_blocks, dtype=torch.int64, device=env.device)
        for k in range(steps):
            td = env.step(policy(td))
            alive, following = measured.alive, td["next"]
            measured = self._after(measured, td)
            for history in histories:
                history.add(k, td, alive)
            if check is not None:
                check(td, alive)
            ended, td = following["terminated"], step_mdp(td)
            if restart:
                restarts += (ended & alive).view(env.n_blocks, -1).sum(-1)
                measured = measured._replace(alive=alive)
                if ended.any():
                    td = env.reset(td.set("_reset", ended))
                    begun = measured.charges.restarted(td[keys.ENERGY].squeeze(-1), ended)
                    measured = measured._replace(charges=begun)
        return measured, restarts

    def _after(self, measured: Measured, td: TensorDictBase) -> Measured:
        """With another transition taken in."""
        self._keys = self._keys or [key for key in READ if key in td.keys(True)]
        alive, charges, sums, least = measured
        found = self._measure(alive, *charges, sums, least, *(td[key] for key in self._keys))
        return Measured(found[0], Charges(*found[1:4]), *found[4:])

    def _measure_tensors(
        self,
        alive: Tensor,
        start: Tensor,
        counted: Tensor,
        count: Tensor,
        sums: Tensor,
        least: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        """:class:`Measured` after a transition whose tensors are in the order of ``_keys``."""
        config = self.env.config
        td = TensorDict(dict(zip(self._keys, tensors, strict=True)), alive.shape[:1])
        energy, next_energy = td[keys.ENERGY].squeeze(-1), td["next"][keys.ENERGY].squeeze(-1)
        found = self._block_numbers(td, alive)
        added = torch.stack([found[name].double() for name in ADDED], dim=-1)
        absent = torch.full_like(found["cost"], math.inf)  # a barrier that the filter does not write
        now = torch.stack([found.get(name, absent).double() for name in LEAST], dim=-1)
        # a margin that is not a number stays so; a barrier that is not a number is passed over
        least = torch.cat([torch.minimum(least[:, :2], now[:, :2]), torch.fmin(least[:, 2:], now[:, 2:])], dim=-1)
        charges = Charges(start, counted, count).after(energy, next_energy, alive, config)
        return alive & ~td["next"]["terminated"], *charges, sums + added, least

    def _block_numbers(self, td: TensorDictBase, alive: Tensor) -> dict[str, Tensor]:
        """What a transition adds to the sums of each block, and its margins and barriers, ``(seeds,)`` by name."""
        config, following, n_blocks = self.env.config, td["next"], self.env.n_blocks

        def blocks(x: Tensor) -> Tensor:
            return x.reshape(n_blocks, -1)

        cost, next_energy = following[keys.COVERAGE_COST], following[keys.ENERGY].squeeze(-1)
        powered = cost
        # a recording does not ask; where it is known that all have power, their cost is the coverage cost
        if self.recorded or not bool((next_energy >= config.energy_min).all()):
            powered = torch.cat([self._powered_cost(part) for part in following.chunk(n_blocks)])
        margin = torch.minimum(next_energy - config.energy_min, config.energy_max - next_energy)
        gap = minimum_distance(td[keys.POSITION], following[keys.POSITION]) - config.safety_distance
        found = {
            "worlds": blocks(alive).sum(-1),
            "cost": blocks(torch.where(alive, cost, 0)).sum(-1, dtype=torch.float64),
            "powered": blocks(torch.where(alive, powered, 0)).sum(-1, dtype=torch.float64),
            "reward": blocks(torch.where(alive, following[keys.REWARD].mean(dim=-2), 0)).sum(-1, dtype=torch.float64),
            "energy_margin": blocks(torch.where(alive, margin, math.inf)).amin(-1),
            "distance_margin": blocks(torch.where(alive.squeeze(-1), gap, math.inf)).amin(-1),
            **filter_numbers(td, config.max_speed, alive, n_blocks),
        }
        for kind in keys.VIOLATION_KINDS:
            found[kind] = blocks(following[(*keys.VIOLATION, kind)].squeeze(-1) & alive).sum(-1)
        return found | {"residual": -found["max_residual"]}

    def _powered_cost(self, state: TensorDictBase) -> Tensor:
        """Coverage cost of the robots that are not drained, ``(B, 1)``, m^2; the coverage cost itself where none is."""
        powered = (state[keys.ENERGY] >= self.env.config.energy_min).squeeze(-1)
        density, position = self.env.density, state[keys.POSITION]
        params = state[keys.DENSITY] if density.n_params else position.new_zeros(len(position), 0)
        rest = (density.points, density.weights(params), density.cell_moment)
        cost = powered_coverage_cost(position, powered, *rest, diameter=self.env.config.diameter).unsqueeze(-1)
        return torch.where(powered.all(dim=-1, keepdim=True), state[keys.COVERAGE_COST], cost)

    def _numbers(self, measured: Measured) -> list[tuple[dict, dict]]:
        """Metrics and the filter's statistics of every block, read from the device."""
        config, blocks, found = self.env.config, self.env.n_blocks, []
        charges = measured.charges.count.view(blocks, -1).to(torch.float64).mean(-1).tolist()
        terminated = (~measured.alive).view(blocks, -1).sum(-1).tolist()
        worlds_of_block = self.env.batch_size.numel() // blocks
        for k, (added, extremes) in enumerate(zip(measured.sums.tolist(), measured.least.tolist(), strict=True)):
            sums, least = dict(zip(ADDED, added, strict=True)), dict(zip(LEAST, extremes, strict=True))
            worlds = max(sums["worlds"], 1)
            metrics = {
                "coverage_cost": _finite(sums["cost"] / worlds),
                "powered_coverage_cost": _finite(sums["powered"] / worlds),
                "episode_reward": _finite(sums["reward"] / worlds_of_block),
                "violations": {kind: int(sums[kind]) for kind in keys.VIOLATION_KINDS},
                "charges_per_robot": charges[k],
                "min_energy_margin": _finite(least["energy_margin"]),
                "min_distance_margin": _finite(least["distance_margin"]),
                "robot_steps": int(sums["worlds"]) * config.n_agents,
                "terminated_worlds": terminated[k],
            }
            statistics = FilterStatistics()
            statistics.add(sums | least | {"max_residual": -least["residual"]})
            found.append((metrics, statistics.summary()))
        return found


def evaluate_policy(
    env: SurveillanceEnv, policy: TensorDictModuleBase, steps: int, *, cuda_graphs: bool = False, **options: Any
) -> Evaluation:
    """A single rollout in worlds of one seed: :class:`Evaluator` and its options."""
    (found,) = Evaluator(env, cuda_graphs=cuda_graphs)(policy, steps, **options)
    return found


def evaluation_scalars(metrics: dict) -> dict[str, float]:
    """The numbers of an evaluation's metrics by TensorBoard tag."""
    scalars: dict[str, float] = {
        f"eval/{name}": value for name, value in metrics.items() if isinstance(value, int | float)
    }
    return scalars | {f"eval/violations_{kind}": count for kind, count in metrics["violations"].items()}


def _finite(value: float) -> float | None:
    """None (JSON null) where there is nothing to measure: one robot's distance, the cost of an unfiltered NaN action."""
    return value if math.isfinite(value) else None


class _History:
    """History of one world, every ``every``-th step until it ends, kept where the world is."""

    def __init__(self, env: SurveillanceEnv, world: int, every: int) -> None:
        self.env, self.world, self.every = env, world, every
        self.samples: dict[str, list[Tensor]] = {
            name: [] for name in ("alive", "position", "energy", "charging", "slot", "density", "coverage_cost")
        }

    def add(self, k: int, td: TensorDictBase, alive: Tensor) -> None:
        """Take in transition k (its next state)."""
        if k % self.every:
            return
        following, density, world = td["next"], self.env.density, self.world
        params = following.get(keys.DENSITY, None)
        rows = {
            "alive": alive[world, 0],
            "position": following[keys.POSITION][world],
            "energy": following[keys.ENERGY][world, :, 0],
            "charging": (following[keys.ENERGY] > td[keys.ENERGY])[world, :, 0],
            "slot": following[keys.SLOT][world, :, 0],
            "coverage_cost": following[keys.COVERAGE_COST][world, 0],
        }
        if density.n_params or not self.samples["density"]:
            weights = density.weights(
                following[keys.POSITION].new_zeros(1, 0) if params is None else params[world : world + 1]
            )
            rows["density"] = weights.reshape(-1)
        for name, row in rows.items():
            self.samples[name].append(row.clone())

    def trajectory(self) -> Trajectory:
        """The history for :mod:`envs.rendering`."""
        env, config = self.env, self.env.config
        arrays = {name: torch.stack(rows).cpu().numpy() for name, rows in self.samples.items()}
        length = int(arrays.pop("alive").sum())
        return Trajectory(
            **{name: rows[:length] for name, rows in arrays.items()},
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
