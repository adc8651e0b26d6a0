"""Controllers that are not learned: bounds, Lloyd's descent, the coverage controller against independent solutions."""

import math

import clarabel
import numpy as np
import pytest
import torch
from scipy import sparse
from torchrl.envs.utils import step_mdp

from agents import make_controller
from agents.adversaries import ADVERSARIES
from agents.controllers import CONTROLLERS
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.battery import charging_field
from envs.config import DENSITIES
from envs.coverage import coverage_cost

torch.set_num_threads(1)
F64 = torch.float64


def drive(controller, env, steps):
    """Unfiltered rollout: states and nominal actions."""
    td, rows = env.reset(), []
    for _ in range(steps):
        td = controller(td)
        td[keys.ACTION] = td[keys.NOMINAL_ACTION]
        td = env.step(td)
        rows.append(td)
        td = step_mdp(td)
    return rows


@pytest.mark.parametrize("name", ["random", *(name for name in CONTROLLERS if name not in (*ADVERSARIES, "learned"))])
@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("d", [2, 3])
def test_nominal_action_is_finite_and_within_the_speed_limit(name, density, d):
    world = SurveillanceConfig(dimension=d, density=density, on_violation="continue")
    worlds = 3 if name == "coverage_cbf_literal" else 16
    for td in drive(make_controller(name, world), SurveillanceEnv(world, worlds, seed=3), 3):
        action = td[keys.NOMINAL_ACTION]
        assert action.shape == (worlds, 3, d)
        assert action.isfinite().all()
        assert action.norm(dim=-1).max() <= world.max_speed * (1 + 1e-6)
    assert action.norm(dim=-1).max() > 1e-3


def test_density_drawn_per_world_is_used():
    world = SurveillanceConfig(density_per_world=True)
    env = SurveillanceEnv(world, 16, seed=0)
    td = env.reset()
    position = td[keys.POSITION][:1].expand(16, -1, -1)  # the same robots in different densities
    td = env.set_state(position, td[keys.ENERGY])
    action = make_controller("lloyd", world)(td)[keys.NOMINAL_ACTION]
    assert (action - action[:1]).norm(dim=-1).amax(-1)[1:].min() > 1e-3


def test_unknown_controller_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'autopilot'.*" + ", ".join(CONTROLLERS)):
        make_controller("autopilot", SurveillanceConfig())


@pytest.mark.parametrize("name", ["lloyd", "charge_when_low", "coverage_cbf", "coverage_cbf_literal"])
def test_controller_is_a_pure_function_of_the_state(name):
    world = SurveillanceConfig()
    td = SurveillanceEnv(world, 4, seed=1).reset()
    controller = make_controller(name, world, seed=0)
    first, again = (controller(td.clone())[keys.NOMINAL_ACTION] for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(first, make_controller(name, world, seed=5)(td.clone())[keys.NOMINAL_ACTION])


# ---- random ----------------------------------------------------------------------------------------------------------
def test_random_has_its_own_generator():
    world = SurveillanceConfig()
    td = SurveillanceEnv(world, 8, seed=0).reset()
    torch.manual_seed(7)
    before = torch.get_rng_state()
    a, b, c = (make_controller("random", world, seed=s) for s in (1, 1, 2))
    x, y, z = (controller(td.clone())[keys.NOMINAL_ACTION] for controller in (a, b, c))
    assert torch.equal(x, y)
    assert not torch.equal(x, z)
    assert not torch.equal(x, a(td.clone())[keys.NOMINAL_ACTION])  # drawn anew each step
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("d", [2, 3])
def test_random_is_uniform_in_the_ball(d):
    world = SurveillanceConfig(dimension=d)
    action = make_controller("random", world)(SurveillanceEnv(world, 3000, seed=0).reset())[keys.NOMINAL_ACTION]
    share = (action.norm(dim=-1) / world.max_speed) ** d  # uniform in [0, 1] for a uniform ball
    edges = torch.tensor([0.25, 0.5, 0.75])
    torch.testing.assert_close(torch.quantile(share, edges), edges, rtol=0, atol=0.03)
    assert action.mean((0, 1)).abs().max() < 0.01


# ---- Lloyd and charge_when_low ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
def test_lloyd_descends_the_coverage_cost(d):
    world = SurveillanceConfig(
        dimension=d, density="uniform", drain_rate=1e-6, on_violation="continue", horizon=0, dtype="float64"
    )
    rows = drive(make_controller("lloyd", world), SurveillanceEnv(world, 16, seed=0), 60)
    cost = torch.stack([row["next"][keys.COVERAGE_COST] for row in rows])
    assert (cost[1:] - cost[:-1]).max() <= 1e-12
    assert (cost[-1] / cost[0]).mean() < 0.8


def test_lloyd_heads_for_the_centroid_of_its_cell():
    world = SurveillanceConfig(n_agents=2, density="uniform", dtype="float64", stations=[[-0.9, 0.0], [0.9, 0.0]])
    env = SurveillanceEnv(world, 1)
    position = torch.tensor([[[-0.31, 0.0], [0.31, 0.0]]], dtype=F64)  # cells: halves, centroids (-+0.5, 0)
    td = make_controller("lloyd", world)(env.set_state(position, torch.full((1, 2, 1), 0.9)))
    expected = torch.tensor([[[-0.19, 0.0], [0.19, 0.0]]], dtype=F64) / world.dt
    expected = expected * world.max_speed / expected.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(td[keys.NOMINAL_ACTION], expected, rtol=2e-6, atol=1e-15)
    near = position.sign() * torch.tensor([0.49, 0.0], dtype=F64)  # one step away it stops there
    td = make_controller("lloyd", world)(env.set_state(near, torch.full((1, 2, 1), 0.9)))
    torch.testing.assert_close(
        near + world.dt * td[keys.NOMINAL_ACTION], position.sign() * torch.tensor([0.5, 0.0]).double()
    )


def test_charge_when_low_goes_home_stays_and_leaves():
    world = SurveillanceConfig(dtype="float64")
    env = SurveillanceEnv(world, 1)
    slots = torch.tensor(world.slot_positions, dtype=F64)[None]
    away = 0.3 * slots
    charge, lloyd = make_controller("charge_when_low", world), make_controller("lloyd", world)

    def act(position, energy):
        td = env.set_state(position, torch.tensor(energy, dtype=F64).view(1, 3, 1), torch.arange(3).view(1, 3, 1))
        return charge(td.clone())[keys.NOMINAL_ACTION][0], lloyd(td.clone())[keys.NOMINAL_ACTION][0]

    action, free = act(away, [0.99, 0.4, 0.99])  # robot 1 has little to spare
    assert torch.equal(action[[0, 2]], free[[0, 2]])
    home = (slots - away)[0, 1]
    torch.testing.assert_close(action[1], world.homing.speed * home / home.norm())
    action, free = act(slots, [0.5, 0.85, 0.95])  # docked: two charge, the full one leaves
    torch.testing.assert_close(action[:2], torch.zeros(2, 2, dtype=F64))
    assert torch.equal(action[2], free[2])
    assert free[2].norm() > 0.1


# ---- coverage_cbf ----------------------------------------------------------------------------------------------------
def coverage_problem(world, worlds, seed=0):
    """Start states, J and dJ/dp by autograd on the quadrature."""
    env = SurveillanceEnv(world, worlds, seed=seed)
    td = env.reset()
    position = td[keys.POSITION].clone().requires_grad_()
    weights = env.density.weights(td[keys.POSITION].new_zeros(worlds, 0))
    cost = coverage_cost(position, env.density.points, weights, env.density.cell_moment)
    (gradient,) = torch.autograd.grad(cost.sum(), position)
    return td, cost.detach().numpy(), gradient.numpy()


@pytest.mark.parametrize("d", [2, 3])
def test_coverage_cbf_solves_its_quadratic_program(d):
    world = SurveillanceConfig(dimension=d, dtype="float64")
    td, cost, gradient = coverage_problem(world, 10)
    controller = make_controller("coverage_cbf", world)
    action = controller(td)[keys.NOMINAL_ACTION].numpy()
    kappa, alpha, n = controller.kappa, controller.alpha, 3 * d
    for b in range(10):
        g = gradient[b].reshape(-1)
        # stationarity in (u, delta) and the active row g.u - delta = -alpha J, unknowns (u, delta, lambda)
        K = np.zeros((n + 2, n + 2))
        K[:n, :n], K[n, n] = 2 * np.eye(n), 2 * kappa
        K[:n, -1] = K[-1, :n] = g
        K[n, -1] = K[-1, n] = -1
        solution = np.linalg.solve(K, np.concatenate([np.zeros(n + 1), [-alpha * cost[b]]]))
        assert solution[-1] > 0  # the row is active
        u = solution[:n].reshape(3, d)
        u = u * np.minimum(1, world.max_speed / np.linalg.norm(u, axis=-1, keepdims=True))
        np.testing.assert_allclose(action[b], u, rtol=1e-6, atol=1e-10)


def literal_program(world, td, b, cost, gradient, kappa, alpha):
    """The literature's joint program of one world by Clarabel, with every row written by hand; None if infeasible."""
    n, d = 3, 2
    alpha_c, alpha_o, alpha_s = 0.2 / world.dt, 0.5 / world.dt, 1 / world.dt
    p, energy = td[keys.POSITION][b], td[keys.ENERGY][b, :, 0].numpy()
    stations = torch.tensor(world.station_positions, dtype=F64)
    radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}
    power = world.charge_rate * charging_field(p, stations, **radii).numpy()
    p, slots = p.numpy(), np.array(world.slot_positions)[td[keys.SLOT][b, :, 0].numpy()]
    rows, bounds = [np.concatenate([gradient.reshape(-1), [-1.0]])], [-alpha * cost]
    slope, radius = world.drain_rate / world.max_speed, world.homing.charge_radius
    for i in range(n):
        way = np.linalg.norm(p[i] - slots[i])
        current = min(1.0, (world.drain_rate + alpha_o * (world.energy_max - energy[i])) / max(power[i], 1e-9))
        h = energy[i] - world.energy_min - slope * max(0.0, way - radius)
        row = np.zeros((n, d))
        row[i] = slope * (p[i] - slots[i]) / way if way > radius else 0
        rows.append(np.append(row, 0))
        bounds.append(power[i] * current - world.drain_rate + alpha_c * h)
        for j in range(i):
            row = np.zeros((n, d))
            row[i], row[j] = -2 * (p[i] - p[j]), 2 * (p[i] - p[j])
            rows.append(np.append(row, 0))
            bounds.append(alpha_s * (((p[i] - p[j]) ** 2).sum() - world.safety_distance**2))
        for k in range(16):
            row = np.zeros((n, d))
            row[i] = math.cos(math.pi * k / 8), math.sin(math.pi * k / 8)
            rows.append(np.append(row, 0))
            bounds.append(world.max_speed * math.cos(math.pi / 16))
    P = sparse.csc_matrix(np.diag([2.0] * (n * d) + [2 * kappa]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    cones = [clarabel.NonnegativeConeT(len(rows))]
    A = sparse.csc_matrix(np.stack(rows))
    solution = clarabel.DefaultSolver(P, np.zeros(n * d + 1), A, np.array(bounds), cones, settings).solve()
    return np.array(solution.x)[:-1].reshape(n, d) if str(solution.status) == "Solved" else None


def test_literal_coverage_controller_solves_the_joint_program():
    world = SurveillanceConfig(dtype="float64", reset_reserve=0.0)
    td, cost, gradient = coverage_problem(world, 12, seed=4)
    low = 0.5 + 0.5 * torch.rand(12, 3, 1, generator=torch.Generator().manual_seed(0), dtype=F64)
    td[keys.ENERGY] = world.energy_min + (td[keys.ENERGY] - world.energy_min) * low  # some are in need
    literal, free = make_controller("coverage_cbf_literal", world), make_controller("coverage_cbf", world)
    action, unconstrained = (c(td.clone())[keys.NOMINAL_ACTION].numpy() for c in (literal, free))
    different = 0
    for b in range(12):
        expected = literal_program(world, td, b, cost[b], gradient[b], literal.kappa, literal.alpha)
        np.testing.assert_allclose(action[b], np.zeros((3, 2)) if expected is None else expected, atol=1e-5)
        different += np.abs(action[b] - unconstrained[b]).max() > 1e-2 and expected is not None
    assert different >= 3
