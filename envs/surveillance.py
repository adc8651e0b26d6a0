"""The surveillance world as a batched TorchRL environment.

A thin shell: physics, batteries, coverage, densities and homing geometry are pure tensor functions of their own
modules; this file packs specs and keys, steps all worlds at once and resets by mask.
"""

import functools
from collections.abc import Sequence
from contextlib import AbstractContextManager

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from envs import keys
from envs.blocks import WorldBlock
from envs.compilation import compiled
from envs.config import SurveillanceConfig
from envs.coverage import squared_distances, voronoi_moments, weighted_sum
from envs.density import Density
from envs.dynamics import components_first, limit_speed
from envs.graphs import check_graphs, graphed
from envs.metrics import violations
from envs.observation import observation_fields, observe
from envs.reassignment import reassign_slots
from envs.specs import make_specs
from envs.starts import draw_starts
from envs.transition import transition

STATE = ("position", "energy", "slot", "step", "density")
"""A world's state, by name."""
CHUNK_DISTANCES = 2**20
"""Squared distances of robots and quadrature points that a step holds at a time."""


class SurveillanceEnv(EnvBase):
    """``num_envs`` independent worlds of ``config``, stepped in parallel.

    Writes the keys of :mod:`envs.keys`; :mod:`envs.observation` lists what a robot observes.

    Args:
        config: the world; a dataclass that has already validated itself.
        num_envs: number of worlds B, >= 1.
        device: where the state lives.
        seed: seed of the environment's own random generator. Several seeds split the worlds into that many equal blocks with a
            generator each (:mod:`envs.blocks`).
        compile_functions: run transition and violation counting through torch.compile; same results to rounding.
        fixed_sizes: let no size in a step depend on the data (:mod:`envs.selection`), so that the host of a GPU waits only
            where a world may be done: never within an episode with ``on_violation=continue``. The same results, slower on a CPU.
            With ``compile_functions`` the whole step is one compiled function.
        cuda_graphs: record a step's kernels once and replay them (:mod:`envs.graphs`); needs ``fixed_sizes``.

    Raises:
        ValueError: if ``num_envs < 1``, or no multiple of the number of seeds; if ``cuda_graphs`` without ``fixed_sizes``.
    """

    def __init__(
        self,
        config: SurveillanceConfig | None = None,
        num_envs: int = 1,
        device: torch.device | str | None = None,
        seed: int | Sequence[int] | None = 0,
        *,
        compile_functions: bool = False,  # TorchRL takes the word compile for itself: all of a step, TensorDicts too
        fixed_sizes: bool = False,
        cuda_graphs: bool = False,
    ) -> None:
        check_graphs(cuda_graphs=cuda_graphs, fixed_sizes=fixed_sizes)
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} is out of range: at least one world is needed.")
        seeds = list(seed) if isinstance(seed, Sequence) else [seed]
        if num_envs % len(seeds):
            raise ValueError(f"num_envs={num_envs} is not a multiple of the number of seeds, {len(seeds)}.")
        config = config or SurveillanceConfig()
        device = torch.device(device or "cpu")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.config = config
        self.fixed_sizes, self.compile_functions = fixed_sizes, compile_functions
        self.geometry = config.homing
        factory = {"dtype": config.torch_dtype, "device": device}
        self.density = Density(config, device)
        self.stations = torch.tensor(config.station_positions, **factory)
        self.slots = torch.tensor(config.slot_positions, **factory)
        self.bounds = torch.tensor(config.bounds, **factory)
        parts = compile_functions and not fixed_sizes
        self._transition = compiled(functools.partial(transition, config=config), enabled=parts)
        self._violations = compiled(functools.partial(violations, config=config), enabled=parts)
        whole = compiled(self.advance, enabled=compile_functions and fixed_sizes, dynamic=False)
        self._advance = graphed(whole, enabled=cuda_graphs)
        self.reference_cost = self.density.reference_cost()
        self.n_blocks = len(seeds)
        self.blocks = [WorldBlock(self, k, torch.Generator(device=device)) for k in range(len(seeds))]
        self.n_observation = list(observation_fields(config, self.density).values())[-1].stop
        specs = make_specs(config, num_envs, self.n_observation, self.density.n_params, len(self.slots), device)
        self.observation_spec, self.action_spec, self.reward_spec, self.done_spec = specs
        for block, own in zip(self.blocks, seeds, strict=True):
            if own is not None:
                block.generator.manual_seed(own)
        self._continues = False
        self.sure_steps = 0.0
        """Steps that every world takes for sure before its episode may end, 0 if not known."""
        self.state = self._blank_state()
        self._write_start(torch.ones(num_envs, dtype=torch.bool, device=device))

    # ---- TorchRL interface -----------------------------------------------------------------------------------------
    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._only_block().generator.manual_seed(seed)

    def any_done(self, tensordict: TensorDictBase) -> bool:
        """As TorchRL's, without looking where no episode can have ended (``on_violation=continue``)."""
        if self.sure_steps > 0:
            return False
        done = tensordict.get("done", None)
        if done is None or bool(done.any()):
            return super().any_done(tensordict)
        if self.config.on_violation == "continue":
            left = self.config.horizon - self.state["step"].max() if self.config.horizon else float("inf")
            self.sure_steps = float(left)
        return False

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.full(self.batch_size, not self._continues, device=self.device)
            self._continues = False
        self.sure_steps = 0.0
        self._write_start(mask.reshape(self.batch_size))
        state = self.state
        _, cost, centroid = self._watch(state["position"], state["density"], advance=False)
        observation = self._observe(*(state[name] for name in STATE), centroid)
        nobody = torch.zeros((*self._robots, len(keys.VIOLATION_KINDS)), dtype=torch.bool, device=self.device)
        never = torch.zeros_like(mask).reshape(-1, 1)
        return self._outputs(observation, cost, nobody, never, never.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        current = tensordict.get(keys.CHARGE_CURRENT, None)
        current = torch.ones_like(self.state["energy"]) if current is None else current.squeeze(-1)
        state = [self.state[name] for name in STATE]
        *state, observation, cost, violated, reward, terminated, truncated = self._advance(
            *state, tensordict[keys.ACTION], current
        )
        self.sure_steps -= 1
        self.state = TensorDict(dict(zip(STATE, state, strict=True)), self.batch_size, device=self.device)
        out = self._outputs(observation, cost, violated, terminated, truncated)
        out[keys.REWARD] = reward
        return out

    def state_dict(self, *args, **kwargs) -> dict:
        """State of all worlds and of the random generator: restoring it continues the same random stream."""
        return self._only_block().state_dict()

    def load_state_dict(self, state_dict: dict, *args, **kwargs) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if the state belongs to another world or another number of worlds.
        """
        self._only_block().load_state_dict(state_dict)

    def continue_from(self, state_dict: dict) -> None:
        """As :meth:`envs.blocks.WorldBlock.continue_from`."""
        self._only_block().continue_from(state_dict)

    def continue_at_reset(self) -> None:
        """The next reset of all worlds returns their present state instead of drawing start states."""
        self._continues = True

    def without_gradients(self) -> AbstractContextManager:
        """Where rollouts are computed: in inference mode, which keeps no books for autograd and saves a seventh of the time.

        Compiled functions, which keep none either, would be compiled a second time for tensors of that mode.
        """
        return torch.no_grad() if self.compile_functions else torch.inference_mode()

    def _only_block(self) -> WorldBlock:
        if self.n_blocks > 1:
            raise ValueError("this environment has several seeds: use its blocks.")
        return self.blocks[0]

    def set_state(self, position: Tensor, energy: Tensor, slot: Tensor | None = None) -> TensorDictBase:
        """Place all robots by hand (tests, replays) and return the outputs of that state, as ``reset`` would.

        Args:
            position: ``(B, N, d)``, m.
            energy: ``(B, N, 1)``.
            slot: ``(B, N, 1)`` int64; unchanged if not given.

        Returns:
            The environment's output keys at the new state.
        """
        self.state["position"] = position.to(self.bounds).expand(*self._robots, -1).clone()
        self.state["energy"] = energy.to(self.bounds).squeeze(-1).expand(self._robots).clone()
        if slot is not None:
            self.state["slot"] = slot.to(self.device).squeeze(-1).expand(self._robots).clone()
        nobody = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return self._reset(TensorDict({"_reset": nobody}, self.batch_size))

    # ---- physics ---------------------------------------------------------------------------------------------------
    def advance(
        self,
        position: Tensor,
        energy: Tensor,
        slot: Tensor,
        step: Tensor,
        density: Tensor,
        action: Tensor,
        current: Tensor,
    ) -> tuple[Tensor, ...]:
        """A step on plain tensors: a function of its arguments alone.

        Args:
            position: ``(B, N, d)``, m.
            energy: ``(B, N)``.
            slot: ``(B, N)`` int64.
            step: ``(B, 1)`` int64, since the episodes began.
            density: ``(B, n_params)``.
            action: ``(B, N, d)``, m/s.
            current: ``(B, N)``, accepted charging current in [0, 1].

        Returns:
            The next of the first five, then observation ``(B, N, n_obs)``, coverage cost ``(B, 1)``, violations ``(B, N, 4)``,
            reward ``(B, N, 1)``, terminated and truncated ``(B, 1)``.
        """
        config, position = self.config, components_first(position)
        velocity = limit_speed(components_first(action.to(position.dtype)), config.max_speed)
        if config.on_violation == "continue":
            velocity = torch.where((energy < config.energy_min).unsqueeze(-1), 0.0, velocity)
        next_position, next_energy = self.transition(position, energy, velocity, current.to(energy.dtype))
        flags = self._violations(position, next_position, next_energy, self.slots)
        violated = torch.stack(list(flags.values()), dim=-1)
        density, cost, centroid = self._watch(next_position, density, advance=True)
        if config.reassign_slots:
            limits = (self.slots, self.geometry, self.bounds)
            slot = reassign_slots(next_position, next_energy, slot, *limits, fixed_sizes=self.fixed_sizes)
        state = (next_position, next_energy, slot, step + 1, density)
        reward = -cost / self.reference_cost
        reward = reward.unsqueeze(-1).expand(*position.shape[:-1], 1).clone()
        terminated = violated.flatten(1).any(dim=-1, keepdim=True)
        if config.on_violation == "continue":
            terminated = torch.zeros_like(terminated)
        truncated = state[3] >= config.horizon if config.horizon else torch.zeros_like(terminated)
        return *state, self._observe(*state, centroid), cost, violated, reward, terminated, truncated

    def transition(self, position: Tensor, energy: Tensor, velocity: Tensor, current: Tensor) -> tuple[Tensor, Tensor]:
        """Raw next position and energy: never saturated by walls or battery.

        Args:
            position: ``(B, N, d)``, m.
            energy: ``(B, N)``.
            velocity: ``(B, N, d)``, m/s.
            current: ``(B, N)``, accepted charging current in [0, 1].

        Returns:
            ``(B, N, d)`` and ``(B, N)``.
        """
        return self._transition(position, energy, velocity, current, self.stations)

    # ---- start states ----------------------------------------------------------------------------------------------
    def _write_start(self, mask: Tensor) -> None:
        """Draw certified start states for the worlds in ``mask`` ``(B,)``; the others keep theirs."""
        for block in self.blocks:
            index = block.draw_index(mask)
            if not (batch := index.numel()):
                continue
            starts = draw_starts(batch, self.config, self.geometry, self.slots, self.bounds, block.generator)
            drawn = dict(zip(("position", "energy", "slot"), starts, strict=True))
            drawn["step"] = torch.zeros(batch, 1, dtype=torch.int64, device=self.device)
            drawn["density"] = self.density.sample(batch, block.generator)
            for name, value in drawn.items():
                self.state[name] = self.state[name].index_copy(0, index, value)

    def compile(self, **_: object) -> None:
        """TorchRL's compilation of a whole step, by its keyword ``compile``, is refused: it would trace TensorDicts."""
        raise TypeError("SurveillanceEnv(compile_functions=True) compiles what is worth it; compile= is TorchRL's.")

    def _blank_state(self) -> TensorDict:
        zeros = {"dtype": self.config.torch_dtype, "device": self.device}
        b, n = self._robots
        return TensorDict(
            {
                "position": torch.zeros(b, n, self.config.dimension, **zeros),
                "energy": torch.zeros(b, n, **zeros),
                "slot": torch.zeros(b, n, dtype=torch.int64, device=self.device),
                "step": torch.zeros(b, 1, dtype=torch.int64, device=self.device),
                "density": torch.zeros(b, self.density.n_params, **zeros),
            },
            self.batch_size,
            device=self.device,
        )

    # ---- outputs ---------------------------------------------------------------------------------------------------
    @property
    def _robots(self) -> tuple[int, int]:
        return self.batch_size[0], self.config.n_agents

    def _watch(self, position: Tensor, params: Tensor, *, advance: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Density parameters, coverage cost ``(B, 1)`` and, if observed, centroids ``(B, N, d)`` of all worlds.

        The Voronoi distances of a chunk of worlds at a time, so that their memory is bounded; never of several blocks, whose
        sums then do not depend on each other's number.
        """
        density, parts = self.density, []
        size = max(1, CHUNK_DISTANCES // (position.shape[-2] * len(density.points)))
        chunks = zip(
            *([c for block in x.chunk(self.n_blocks) for c in block.split(size)] for x in (position, params)),
            strict=True,
        )
        for robots, now in chunks:
            squared = squared_distances(robots, density.points, clamp=False)
            nearest = squared.amin(dim=-2).clamp_min(0)
            after = density.advance(now, nearest) if advance else now
            weights = density.weights(after)
            cost = weighted_sum(nearest, weights).unsqueeze(-1) + density.cell_moment
            centroid = robots
            if self.config.observe_centroid:
                _, centroid = voronoi_moments(robots, density.points, weights, squared)
            parts.append((after, cost, centroid))
        params, cost, centroid = parts[0] if len(parts) == 1 else (torch.cat(x) for x in zip(*parts, strict=True))
        return params, cost, centroid if self.config.observe_centroid else None

    def _outputs(
        self, observation: Tensor, cost: Tensor, violated: Tensor, terminated: Tensor, truncated: Tensor
    ) -> TensorDict:
        """All keys that describe the present state, ``violated`` ``(B, N, 4)`` by kind."""
        state = self.state
        out: dict[NestedKey, Tensor] = {
            keys.OBSERVATION: observation,
            keys.POSITION: state["position"].clone(),
            keys.ENERGY: state["energy"].unsqueeze(-1).clone(),
            keys.SLOT: state["slot"].unsqueeze(-1).clone(),
            keys.COVERAGE_COST: cost,
            keys.STEP_COUNT: state["step"].clone(),
        }
        if self.density.n_params:
            out[keys.DENSITY] = state["density"].clone()
        for kind, flag in zip(keys.VIOLATION_KINDS, violated.split(1, dim=-1), strict=True):
            out[(*keys.VIOLATION, kind)] = flag
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        for name, flag in flags.items():
            out[name] = flag
            out[(keys.AGENTS, name)] = flag.unsqueeze(-1).expand(*self._robots, 1).clone()
        return TensorDict(out, self.batch_size, device=self.device)

    def _observe(
        self, position: Tensor, energy: Tensor, slot: Tensor, step: Tensor, density: Tensor, centroid: Tensor | None
    ) -> Tensor:
        seen, middle = self.density.observe(density), self.bounds.mean(-1)
        own = (position, energy, self.slots[slot], step)
        return observe(*own, centroid, seen, self.stations, middle, self.config)
