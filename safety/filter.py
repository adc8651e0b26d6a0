"""The safety filter: nominal action in, executed action out.

Per robot, or per world with split=joint:

    min ||u - u^||^2   s.t.   L_F h + L_G h (u, c) >= -alpha h  for the barriers' rows,   ||u|| <= max_speed,

with the accepted current ``c`` in closed form (nominal current 1; more current never hurts survivability). No row is
ever relaxed: a problem without solution, or one the solver could not solve to its tolerance, falls to **hold**
(``u = 0``) and is flagged in ("filter", "status"). The nominal action is never executed unfiltered.

* ``mode=certified``: rows of :mod:`safety.certified_rows`, shield of :mod:`safety.certificate`. From a certified state
  the next state is certified, whatever the nominal action and the solver: ("filter", "level") tells who decided, 0 the
  program, 1 hold, 2 homing.
* ``mode=paper``: the rows are the literature's and hold is the last resort, so holding, another robot or the length of a
  step can still lead to a violation; the environment counts those.
* ``mode=dalal``: no program, the learned layer of :mod:`safety.dalal`; its violations are counted too.
"""

import functools

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs import keys
from envs.battery import charge, charging_field
from envs.compilation import compiled
from envs.config import SurveillanceConfig
from envs.dynamics import FULL_SPEED, components_first, limit_speed
from envs.graphs import check_graphs, graphed
from envs.transition import transition
from safety.barriers import (
    BarrierRow,
    accepted_current,
    literal_geometry,
    literature_barriers,
    overcharge_barrier,
    sampled_energy_row,
    without_self,
)
from safety.certificate import HOLD, HOMING, outside, pair_minimum, shield
from safety.certified_rows import Rows, certified_rows
from safety.config import SafetyConfig
from safety.dalal import DalalLayer
from safety.programs import joint_solver, solve_jointly, solve_per_robot
from safety.qp import QPStatus, solve_qp
from safety.speed_faces import joint_rows


class SafetyFilter(TensorDictModuleBase):
    """Reads nominal action, position, energy and slot; writes executed action, accepted current and diagnostics.

    A pure function of what it reads: no state, no randomness. Keys and shapes:

    * in: nominal_action ``(*B, N, d)`` m/s, position ``(*B, N, d)`` m, energy ``(*B, N, 1)``, slot ``(*B, N, 1)`` int64.
    * out: action ``(*B, N, d)`` m/s in the speed ball, charge_current ``(*B, N, 1)`` in [0, 1], correction
      ``(*B, N, 1)`` = ||u - u^|| with u^ first cut to the speed ball, status and level ``(*B, N)`` int64, residual
      and the barriers h_c, h_o, h_s (smallest over the pairs) ``(*B, N, 1)``, outside ``(*B, N)`` bool: a state that
      the filter makes no promise for (certified: not in the certified set, the robot drives home; others: a barrier is
      negative). h_c takes the filter's own reserve. certified also writes h_g = G - Delta_G ``(*B, N, 1)``, the
      smallest over the pairs.

    A non-finite nominal action is replaced by hold, flagged INACCURATE and counted, as a correction of max_speed.

    Args:
        safety: which filter.
        world: the world it stands in.
        compile: torch.compile of the shield's transition, with ``fixed_sizes`` of the whole filter; same to rounding.
        fixed_sizes: compute everything for all robots, so that no size depends on the data and the host of a GPU never waits.
            Slower on a CPU; the same results, but where a problem has no closed form within tolerance (it counts as
            INACCURATE, infeasible ones too) and where a certificate fails (all robots of that world drive home).
        cuda_graphs: record the kernels once and replay them (:mod:`envs.graphs`); needs ``fixed_sizes``.

    The position's type and device are the filter's; other inputs are converted to its type.

    Raises:
        ValueError: if a gain does not fit the world's time step or certificate, or ``fixed_sizes`` the solver or the graphs.
        KeyError: from ``forward``, if an input key is missing.
        ValueError: from ``forward``, if an input's shape or type is not the world's.
    """

    def __init__(
        self,
        safety: SafetyConfig,
        world: SurveillanceConfig,
        *,
        compile: bool = False,
        fixed_sizes: bool = False,
        cuda_graphs: bool = False,
    ) -> None:
        super().__init__()
        check_graphs(cuda_graphs=cuda_graphs, fixed_sizes=fixed_sizes)
        safety.check_sizes(fixed_sizes=fixed_sizes)
        self.safety = safety
        self.world = world
        self.fixed_sizes = fixed_sizes
        self.gains = safety.gains(world)
        self.literal = literal_geometry(world)
        self.geometry = world.homing
        self.in_keys = [keys.NOMINAL_ACTION, keys.POSITION, keys.ENERGY, keys.SLOT]
        self.out_keys = [
            *(keys.ACTION, keys.CHARGE_CURRENT, keys.CORRECTION, keys.STATUS, keys.LEVEL, keys.RESIDUAL),
            *(keys.BARRIER_ENERGY, keys.BARRIER_OVERCHARGE, keys.BARRIER_COLLISION, keys.OUTSIDE),
        ]
        if safety.mode == "certified":
            self.out_keys.append(keys.BARRIER_CERTIFICATE)
        self._transition = compiled(functools.partial(transition, config=world), enabled=compile and not fixed_sizes)
        whole = compiled(self.filter, enabled=compile and fixed_sizes, dynamic=False)
        self._filter = graphed(whole, enabled=cuda_graphs)
        self.layer = DalalLayer(safety, world) if safety.mode == "dalal" else None
        self._layouts: dict[tuple[torch.device, torch.dtype], tuple[Tensor, ...]] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Filter the nominal action of ``tensordict`` and write the results into it."""
        inputs = [tensordict.get(key, None) for key in self.in_keys]
        missing = [key for key, value in zip(self.in_keys, inputs, strict=True) if value is None]
        if missing:
            raise KeyError(
                f"SafetyFilter needs {missing}, the tensordict has {sorted(map(str, tensordict.keys(True, True)))}."
            )
        nominal, position, energy, slot = inputs
        self._check_shapes(inputs)
        self._layout(position)  # made before anything is traced
        outputs = self._filter(nominal, position, energy.squeeze(-1), slot.squeeze(-1))
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict

    def _check_shapes(self, inputs: list[Tensor]) -> None:
        n, d = self.world.n_agents, self.world.dimension
        batch = inputs[1].shape[:-2]
        for key, value, width in zip(self.in_keys, inputs, (d, d, 1, 1), strict=True):
            if value.shape != (*batch, n, width):
                raise ValueError(
                    f"{key} has shape {tuple(value.shape)}: this filter's world (n_agents={n}, dimension={d}) needs "
                    f"(*B, {n}, {width}), *B as {keys.POSITION}'s, {tuple(batch)}."
                )
        if not inputs[1].is_floating_point() or inputs[3].dtype != torch.int64:
            raise ValueError(
                f"{keys.POSITION} is {inputs[1].dtype} and {keys.SLOT} {inputs[3].dtype}: floating point and int64 needed."
            )

    def filter(self, nominal: Tensor, position: Tensor, energy: Tensor, slot: Tensor) -> tuple[Tensor, ...]:
        """The filter on plain tensors, in the order of ``out_keys``.

        Args:
            nominal: ``(*B, N, d)``, m/s.
            position: ``(*B, N, d)``, m.
            energy: ``(*B, N)``.
            slot: ``(*B, N)`` int64.

        Returns:
            The tensors of ``out_keys``.
        """
        nominal, energy = components_first(nominal.to(position.dtype)), energy.to(position.dtype)
        position = components_first(position)
        finite = nominal.isfinite().all(dim=-1)
        target = limit_speed(torch.where(finite.unsqueeze(-1), nominal, 0.0), self.world.max_speed, FULL_SPEED)
        if self.safety.mode == "certified":
            action, current, status, residual, level, *diagnostics = self._certified(
                target, finite, position, energy, slot
            )
        else:
            h_c, h_o, h_s = self._barriers(position, energy, slot)
            diagnostics = [h_c.value, h_o.value, h_s.value.amin(dim=-1)]
            diagnostics.append(~(torch.stack(diagnostics) >= 0).all(dim=0))
            if self.safety.mode == "none":
                action = target = limit_speed(nominal, self.world.max_speed, FULL_SPEED)
                current = torch.ones_like(energy)
                status = level = torch.zeros_like(slot)
                residual = torch.zeros_like(energy)
            else:
                solve = self.layer or self._program
                action, current, status, residual = solve(target, position, energy, slot, h_c, h_o, h_s)
                status = torch.where(finite, status, int(QPStatus.INACCURATE))
                hold = status != QPStatus.SOLVED.value
                action = torch.where(hold.unsqueeze(-1), 0.0, action)
                level = hold.to(torch.int64)
        # the gradient of the norm at 0 is 0, not NaN
        squared = (action - target).square().sum(-1, keepdim=True)
        correction = torch.where(squared > 0, squared.clamp_min(torch.finfo(squared.dtype).tiny).sqrt(), 0.0)
        correction = torch.where(finite.unsqueeze(-1), correction, self.world.max_speed)
        outputs = (action, current, correction.squeeze(-1), status, level, residual, *diagnostics)
        whole = (keys.ACTION, keys.STATUS, keys.LEVEL, keys.OUTSIDE)
        return tuple(x if key in whole else x.unsqueeze(-1) for key, x in zip(self.out_keys, outputs, strict=True))

    def _certified(
        self, target: Tensor, finite: Tensor, position: Tensor, energy: Tensor, slot: Tensor
    ) -> tuple[Tensor, ...]:
        """Programs and shield: ``(action, current, status, residual, level, h_c, h_o, h_s, outside, h_g)``."""
        world, geometry, shape = self.world, self.geometry, target.shape
        stations, slots, bounds = self._layout(position)
        field = self._field(position)
        rates = {"drain_rate": world.drain_rate, "charge_rate": world.charge_rate}
        h_o = overcharge_barrier(energy, field, energy_max=world.energy_max - geometry.eps_energy, **rates)
        current, _ = accepted_current(h_o, self.gains.overcharge)
        # standing still drains least: no action may lift the energy over its limit, not even by a rounding
        rest = torch.full_like(energy, world.drain_rate)
        fullest = charge(energy, field, current, rest, charge_rate=world.charge_rate, dt=world.dt)
        current = torch.where(fullest > world.energy_max, 0.0, current)
        next_energy = energy + world.dt * (world.charge_rate * field * current - geometry.drain_rate)
        flat = [x.reshape(-1, *shape[-2:]) for x in (target, position, components_first(slots[slot]))]
        flat += [x.reshape(-1, shape[-2]) for x in (energy, next_energy, current, finite)]
        target, position, home, energy, next_energy, flat_current, finite = flat
        h_c, normal, bound = sampled_energy_row(
            *(position, energy, next_energy, home, geometry),
            gain=self.gains.energy * world.dt,
            step=world.max_speed * world.dt,
        )
        rows = certified_rows(
            *(position, home, normal, bound, bounds, geometry, self.gains),
            safety_distance=world.safety_distance,
            max_speed=world.max_speed,
            anchored=self.safety.split != "half",
            target=target.detach(),
            fixed_sizes=self.fixed_sizes,
        )
        action, status, residual = self._solve_pressed(target, rows)
        action = limit_speed(action, world.max_speed)  # as the environment will: the shield trusts no solver
        status = torch.where(finite, status, int(QPStatus.INACCURATE))
        beyond = outside(position, energy, home, rows.closest, geometry, bounds)
        level = torch.where(status == QPStatus.SOLVED.value, 0, HOLD)
        level = torch.where(beyond, HOMING, level)
        action, level, _ = shield(
            lambda *state: self._transition(*state, stations),
            *(position, energy, home, action, flat_current, level, rows.closest, geometry, bounds),
            max_speed=world.max_speed,
            fixed_sizes=self.fixed_sizes,
        )
        least = pair_minimum(torch.cat([rows.closest, rows.distance]), shape[-2])
        closest, distance = least[: len(energy)], least[len(energy) :]
        values = (
            h_c + 2 * geometry.eps_energy,
            world.energy_max - energy,
            distance.square() - world.safety_distance**2,
        )
        flat = (status, residual, level, *values, beyond, closest - geometry.clearance)
        return action.reshape(shape), current, *(x.reshape(shape[:-1]) for x in flat)

    def _program(
        self,
        target: Tensor,
        position: Tensor,
        energy: Tensor,
        slot: Tensor,
        h_c: BarrierRow,
        h_o: BarrierRow,
        h_s: BarrierRow,
    ) -> tuple[Tensor, ...]:
        """Rows, current and solution: ``(action, current, status, residual)``."""
        alpha_c, alpha_o, alpha_s, _ = self.gains
        if self.safety.sampled_data:
            # one rounding margin: a robot that stays docked approaches E_max to the last bit
            h_o = h_o._replace(value=h_o.value - self.geometry.eps_energy)
        current, chargeable = accepted_current(h_o, alpha_o)
        active_c = active_o = torch.ones_like(chargeable)
        active_s = torch.isfinite(h_s.value)
        if self.safety.composition == "min":
            # h_i = min(h_c, h_o, pairs); ties go to the lowest index, which argmin returns
            smallest = torch.cat([h_c.value.unsqueeze(-1), h_o.value.unsqueeze(-1), h_s.value], dim=-1).argmin(dim=-1)
            chosen = torch.nn.functional.one_hot(smallest, 2 + h_s.value.shape[-1]).bool()
            active_c, active_o, active_s = chosen[..., 0], chosen[..., 1], chosen[..., 2:]
            current = torch.where(active_o & chargeable, current, 1.0)
        impossible = active_o & ~chargeable
        if self.safety.sampled_data:
            # the robot may drain at full power whatever it does, so its next energy is bounded by that
            next_energy = energy + self.world.dt * (h_c.drift + h_c.current_gain * current)
            _, slots, _ = self._layout(position)
            dt, step = self.world.dt, self.world.max_speed * self.world.dt
            arguments = (position, energy, next_energy, slots[slot], self.geometry)
            _, gain_c, bound_c = sampled_energy_row(*arguments, gain=alpha_c * dt, step=step)
        else:
            gain_c, bound_c = -h_c.velocity_gain, h_c.drift + h_c.current_gain * current + alpha_c * h_c.value
        bound_c = torch.where(active_c, bound_c, torch.inf)
        bound_s = torch.where(active_s, alpha_s * h_s.value, torch.inf)
        gain_s = -h_s.velocity_gain
        if self.safety.split == "joint":
            rows = (gain_c, bound_c, gain_s, bound_s, self.world.max_speed)
            action, status, residual = solve_jointly(target, *rows, self.safety.solver)
        else:
            share = 1.0 if self.safety.split == "full" else 0.5
            G = torch.cat([gain_c.unsqueeze(-2), without_self(gain_s)], dim=-2)
            h = torch.cat([bound_c.unsqueeze(-1), share * without_self(bound_s.unsqueeze(-1)).squeeze(-1)], dim=-1)
            action, status, residual = self._solve_per_robot(target, G, h)
        status = torch.where(impossible, int(QPStatus.INFEASIBLE), status)
        return action, current, status, residual

    def _solve_pressed(self, target: Tensor, rows: Rows) -> tuple[Tensor, Tensor, Tensor]:
        """Programs of the robots that have rows; the others keep their target ``(M, N, d)`` bit for bit."""
        m, n, d = target.shape
        status, residual = torch.zeros(m * n, dtype=torch.int64, device=target.device), target.new_zeros(m * n)
        action = target.reshape(-1, d)
        if self.fixed_sizes:  # all robots, in order
            solution, status, residual = self._solve_per_robot(action, rows.G, rows.h)
            action = torch.where(rows.pressed.unsqueeze(-1), solution, action)
            status, residual = torch.where(rows.pressed, status, 0), torch.where(rows.pressed, residual, 0.0)
        elif len(rows.robots):
            solution = self._solve_per_robot(action[rows.robots], rows.G, rows.h)
            action = action.index_copy(0, rows.robots, solution[0])
            status[rows.robots], residual[rows.robots] = solution[1], solution[2]
        return action.view(m, n, d), status.view(m, n), residual.view(m, n)

    def _solve_per_robot(self, target: Tensor, G: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        settings = (self.world.max_speed, self.safety.solver)
        return solve_per_robot(target, G, h, *settings, fixed_sizes=self.fixed_sizes)

    def solve_task(self, Q: Tensor, p: Tensor, position: Tensor, energy: Tensor, slot: Tensor) -> Tensor:
        """Joint quadratic program of a task controller under this filter's rows; hold where it cannot be solved.

        Args:
            Q: ``(*B, N d, N d)``, symmetric positive definite.
            p: ``(*B, N d)``.
            position: ``(*B, N, d)``, m.
            energy: ``(*B, N)``.
            slot: ``(*B, N)`` int64.

        Returns:
            ``(*B, N, d)``, m/s.
        """
        h_c, h_o, h_s = self._barriers(position, energy, slot)
        alpha_c, alpha_o, alpha_s, _ = self.gains
        current, _ = accepted_current(h_o, alpha_o)
        bound_c = h_c.drift + h_c.current_gain * current + alpha_c * h_c.value
        gains = (-h_c.velocity_gain, bound_c, -h_s.velocity_gain, alpha_s * h_s.value)
        G, h = joint_rows(*gains, self.world.max_speed)
        solution = solve_qp(Q, p, G, h, solver=joint_solver(self.safety.solver))
        solved = (solution.status == QPStatus.SOLVED).unsqueeze(-1)
        return torch.where(solved, solution.value, 0.0).unflatten(-1, position.shape[-2:])

    def _field(self, position: Tensor) -> Tensor:
        radii = {"full_radius": self.world.charge_radius_full, "zero_radius": self.world.charge_radius}
        return charging_field(position, self._layout(position)[0], **radii)

    def _barriers(self, position: Tensor, energy: Tensor, slot: Tensor) -> tuple[BarrierRow, BarrierRow, BarrierRow]:
        """The literature's rows ``h_c (*B, N)``, ``h_o (*B, N)`` and ``h_s (*B, N, N)`` of a state."""
        home = self._layout(position)[1][slot]
        return literature_barriers(position, energy, home, self._field(position), self.literal, self.world)

    def _layout(self, like: Tensor) -> tuple[Tensor, ...]:
        """Stations, slots and arena on the device and in the type of ``like``. Not buffers: the loss must not copy them."""
        key = (like.device, like.dtype)
        if key not in self._layouts:
            world = self.world
            given = (world.station_positions, world.slot_positions, world.bounds)
            self._layouts[key] = tuple(torch.tensor(part, dtype=like.dtype, device=like.device) for part in given)
        return self._layouts[key]
