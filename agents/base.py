"""What all controllers that are not learned share: keys, the world's geometry, own generator, own memory."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs import SurveillanceConfig, keys
from envs.density import Density
from envs.homing import homing_velocity, reserve


class Controller(TensorDictModuleBase):
    """Base of all controllers: a pure function of the states and of the controller's own memory and generator.

    The random ones draw from their own generator only (same seed and same states, same actions). The memory (way-points,
    goals, a coloured noise's present value) belongs to one batch of worlds: it starts afresh when the shape, type or
    device of the positions changes, and lives on through resets of single worlds.

    Args:
        world: the world.
        seed: seed of the controller's generator.
    """

    def __init__(self, world: SurveillanceConfig, seed: int = 0) -> None:
        super().__init__()
        self.world = world
        self.seed = seed
        self.geometry = world.homing
        self.in_keys = [keys.POSITION, keys.ENERGY, keys.SLOT]
        self.out_keys = [keys.NOMINAL_ACTION]
        self._on: dict[torch.device, tuple[Density, Tensor, torch.Generator]] = {}
        self._arena: dict[torch.device, Tensor] = {}
        self._memory: dict[str, Tensor] = {}
        self._memory_of: tuple | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the nominal action."""
        tensordict.set(keys.NOMINAL_ACTION, self.act(tensordict))
        return tensordict

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """Nominal action ``(*B, N, d)``, m/s."""
        raise NotImplementedError

    def metrics(self) -> dict[str, float]:
        """What the controller itself counted since its memory started, by name; nothing by default."""
        return {}

    def tools(self, like: Tensor) -> tuple[Density, Tensor, torch.Generator]:
        """Density, slots ``(S, d)`` and generator on the device of ``like``."""
        if like.device not in self._on:
            slots = torch.tensor(self.world.slot_positions, dtype=self.world.torch_dtype, device=like.device)
            generator = torch.Generator(device=like.device).manual_seed(self.seed)
            self._on[like.device] = (Density(self.world, like.device), slots, generator)
        return self._on[like.device]

    def weights(self, tensordict: TensorDictBase) -> tuple[Density, Tensor]:
        """Density and the present weights of its quadrature points."""
        position = tensordict[keys.POSITION]
        density, _, _ = self.tools(position)
        params = tensordict[keys.DENSITY] if density.n_params else position.new_zeros(*position.shape[:-2], 0)
        return density, density.weights(params)

    def places(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Positions and positions of the own slots, ``(*B, N, d)`` each, m."""
        position = tensordict[keys.POSITION]
        _, slots, _ = self.tools(position)
        return position, slots.to(position.dtype)[tensordict[keys.SLOT].squeeze(-1)]

    def way_to_charge(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Who drives home to charge or stays to be charged, ``(*B, N)`` bool, and the way home, ``(*B, N, d)`` m/s.

        A robot goes when its energy nears the reserve, and stays until nearly full. The hysteresis needs no memory: a
        robot inside its slot's charging radius that is not full stays.
        """
        world, geometry = self.world, self.geometry
        position, slot_position = self.places(tensordict)
        energy = tensordict[keys.ENERGY].squeeze(-1)
        way = (position - slot_position).norm(dim=-1)
        span = world.energy_max - world.energy_min
        low = energy - world.energy_min - reserve(way, geometry) <= 0.15 * span
        charging = (way <= geometry.charge_radius) & (energy < world.energy_max - 0.1 * span)
        return low | charging, homing_velocity(position, slot_position, geometry)

    def memory(self, like: Tensor, start: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
        """The memory that belongs to positions such as ``like``, made by ``start`` where there is none; to be written to."""
        kind = (like.shape, like.dtype, like.device)
        if kind != self._memory_of:
            self._memory, self._memory_of = start(), kind
        return self._memory

    # ---- own randomness --------------------------------------------------------------------------------------------
    def uniform(self, like: Tensor, *shape: int) -> Tensor:
        """Uniform in [0, 1), type and device of ``like``."""
        return torch.rand(shape, generator=self.tools(like)[2], dtype=like.dtype, device=like.device)

    def normal(self, like: Tensor, *shape: int) -> Tensor:
        """Standard normal, type and device of ``like``."""
        return torch.randn(shape, generator=self.tools(like)[2], dtype=like.dtype, device=like.device)

    def points(self, like: Tensor, *shape: int) -> Tensor:
        """Points uniform in the arena, ``(*shape, d)``, m."""
        low, high = self.arena(like).unbind(-1)
        return low + (high - low) * self.uniform(like, *shape, like.shape[-1])

    def arena(self, like: Tensor) -> Tensor:
        """The arena ``(d, 2)``, m, type and device of ``like``."""
        if like.device not in self._arena:
            self._arena[like.device] = torch.tensor(self.world.bounds, dtype=torch.float64, device=like.device)
        return self._arena[like.device].to(like.dtype)
