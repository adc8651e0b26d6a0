"""The safety filter: identity, cuts, fallback, variants, gradients, and what it does to violations in the world."""

import itertools
import math

import pytest
import torch
from scipy.spatial import HalfspaceIntersection
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import step_mdp

from agents import make_controller
from agents.evaluation import evaluate_policy
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.battery import charging_field
from safety import QPStatus, SafetyConfig, SafetyFilter
from safety.programs import solve_jointly
from safety.speed_faces import speed_faces

torch.set_num_threads(1)
F64 = torch.float64
SPEED = 0.2
VARIANTS = [
    {"composition": composition, "split": split, "sampled_data": sampled}
    for composition, split, sampled in (
        *itertools.product(["stacked"], ["half", "full", "joint"], [True, False]),
        *itertools.product(["min"], ["half", "full", "joint"], [False]),
    )
]
ALL_VARIANTS = pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: "-".join(map(str, v.values())))
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])
DTYPES = pytest.mark.parametrize("dtype", ["float32", "float64"])
LITERAL = {"composition": "min", "split": "full", "sampled_data": False}


def make_world(**fields):
    return SurveillanceConfig(**({"horizon": 0, "max_speed": SPEED} | fields))


def uniform(*shape, seed, dtype="float32"):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=getattr(torch, dtype))


def random_inputs(world, batch, seed=0):
    """Nominal action, position, energy, slot: mostly safe states, the last third anywhere."""
    start = SurveillanceEnv(world, batch, seed=seed).reset()
    position, energy, slot = start[keys.POSITION], start[keys.ENERGY].squeeze(-1), start[keys.SLOT].squeeze(-1)
    wild, shape = 2 * batch // 3, position[2 * batch // 3 :].shape
    position[wild:] = 0.5 * (2 * uniform(*shape, seed=seed + 1, dtype=world.dtype) - 1)
    energy[wild:] = 1.2 * uniform(*shape[:-1], seed=seed + 2, dtype=world.dtype)
    nominal = 2 * SPEED * (2 * uniform(*position.shape, seed=seed + 3, dtype=world.dtype) - 1)
    return nominal, position, energy, slot


def calm_inputs(world, batch=4, *, share=0.5, seed=0):
    """Robots in the middle of their way, far apart, batteries at 0.9: nothing to correct below share * max_speed."""
    slots = torch.tensor(world.slot_positions, dtype=world.torch_dtype)[: world.n_agents]
    position = (0.7 * slots).expand(batch, -1, -1)
    nominal = torch.randn(position.shape, generator=torch.Generator().manual_seed(seed)).to(position)
    nominal = share * SPEED * nominal / nominal.norm(dim=-1, keepdim=True)
    energy = torch.full(position.shape[:-1], 0.9, dtype=position.dtype)
    return nominal, position, energy, torch.arange(world.n_agents).expand(position.shape[:-1])


def run(world, inputs, **safety):
    """Outputs by short name."""
    f = SafetyFilter(SafetyConfig(**{"mode": "paper", **safety}), world)
    return dict(zip((key[-1] for key in f.out_keys), f.filter(*inputs), strict=True))


# ---- what is safe passes ---------------------------------------------------------------------------------------------
@ALL_VARIANTS
@DIMENSIONS
@DTYPES
def test_safe_action_passes_bit_for_bit(variant, d, dtype):
    world = make_world(dimension=d, dtype=dtype)
    inputs = calm_inputs(world)
    out = run(world, inputs, **variant)
    assert torch.equal(out["action"], inputs[0])
    assert out["action"].dtype == inputs[0].dtype
    assert (out["status"] == 0).all()
    assert (out["level"] == 0).all()
    assert (out["correction"] == 0).all()
    assert all((out[name] > 0).all() for name in ("h_c", "h_o", "h_s"))


@pytest.mark.parametrize("variant", [{"mode": "certified"}, {"split": "half"}, {}, {"mode": "none"}], ids=str)
@DIMENSIONS
@DTYPES
def test_nothing_is_corrected_at_the_speed_limit_and_no_executed_speed_exceeds_it(variant, d, dtype):
    world = make_world(dimension=d, dtype=dtype)
    nominal, *state = calm_inputs(world, 4000, share=1.0)
    share = torch.linspace(1 - 1e-6, 1 + 1e-6, len(nominal), dtype=nominal.dtype).reshape(-1, 1, 1)
    out = run(world, (nominal * share, *state), **variant)
    speed, limit = out["action"].norm(dim=-1), torch.tensor(SPEED, dtype=nominal.dtype)
    assert (speed <= limit).all()
    assert (speed.double() > SPEED * (1 - 2e-6)).all()
    assert (out["correction"] == 0).all()


@pytest.mark.parametrize("solver", ["auto", "pdipm"])
def test_no_speed_exceeds_the_limit_at_the_corners_of_its_polygon(solver):
    n = 3
    angle = torch.arange(32 * n).reshape(32, n) * (2 * math.pi / 32)  # every other one points to a corner
    none, free = torch.zeros(32, n, n, 2), torch.full((32, n, n), torch.inf)
    for limit in torch.linspace(0.05, 3, 30).tolist():
        target = 1.5 * limit * torch.stack([angle.cos(), angle.sin()], dim=-1)
        value, status, _ = solve_jointly(target, none[:, 0], free[:, 0], none, free, limit, solver)
        speed = value.norm(dim=-1)
        assert (status == QPStatus.SOLVED).all()
        assert (speed <= torch.tensor(limit)).all()
        assert (speed > 0.98 * limit).all()


def test_safe_action_passes_bit_for_bit_through_qpth_per_robot():
    world = make_world()
    inputs = calm_inputs(world)
    assert torch.equal(run(world, inputs, solver="qpth")["action"], inputs[0])


@pytest.mark.parametrize("mode", ["paper", "none"])
@DIMENSIONS
def test_action_outside_the_ball_is_cut_along_itself(mode, d):
    world = make_world(dimension=d)
    inputs = calm_inputs(world, share=3.0)
    out = run(world, inputs, mode=mode)
    torch.testing.assert_close(out["action"], inputs[0] / 3, rtol=1e-5, atol=1e-7)
    assert out["action"].norm(dim=-1).max() <= SPEED
    assert out["correction"].max() <= 1e-6 * SPEED  # the speed limit is no correction


def test_no_filter_only_cuts():
    world = make_world(n_agents=2)
    position = torch.tensor([[[0.0, 0.0], [0.05, 0.0]]])
    nominal = torch.tensor([[[0.1, 0.0], [-0.5, 0.0]]])
    inputs = (nominal, position, torch.full((1, 2), 0.05), torch.arange(2)[None])
    out = run(world, inputs, mode="none")
    torch.testing.assert_close(out["action"], torch.tensor([[[0.1, 0.0], [-0.2, 0.0]]]))
    assert (out["charge_current"] == 1).all()
    assert (out["level"] == 0).all()
    assert (out["h_s"] < 0).all()  # it still says what it sees
    assert (out["h_c"] < 0).all()


# ---- what cannot be filtered holds -----------------------------------------------------------------------------------
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("split", ["half", "full", "joint"])
def test_robot_with_non_finite_nominal_holds(bad, split):
    world = make_world()
    nominal, *rest = calm_inputs(world)
    broken = nominal.clone()
    broken[:, 1, 0] = bad
    out = run(world, (broken, *rest), split=split)
    assert (out["action"][:, 1] == 0).all()
    assert (out["status"][:, 1] == QPStatus.INACCURATE).all()
    assert (out["level"][:, 1] == 1).all()
    assert torch.equal(out["action"][:, [0, 2]], nominal[:, [0, 2]])
    assert (out["level"][:, [0, 2]] == 0).all()
    assert all(value.isfinite().all() for value in out.values())


def test_energy_beyond_rescue_holds_and_says_so():
    world = make_world()
    nominal, position, energy, slot = calm_inputs(world)
    position, energy = 0.1 * position, energy.clone()
    energy[:, 2] = world.energy_min + 0.001  # far from home, empty
    out = run(world, (nominal, position.contiguous(), energy, slot), composition="stacked")
    assert (out["h_c"][:, 2] < -0.1).all()
    assert (out["status"][:, 2] == QPStatus.INFEASIBLE).all()
    assert (out["level"][:, 2] == 1).all()
    assert (out["action"][:, 2] == 0).all()


def test_energy_above_the_limit_beyond_rescue_holds_and_says_so():
    world = make_world()
    nominal, position, energy, slot = calm_inputs(world)
    energy = energy.clone()
    fall = world.drain_rate * world.dt / 0.5  # alpha_o asks for half of the excess per step, the drain takes this much
    energy[:, 0], energy[:, 1] = world.energy_max + 0.9 * fall, world.energy_max + 1.1 * fall
    out = run(world, (nominal, position, energy, slot))
    assert out["status"][0].tolist() == [QPStatus.SOLVED, QPStatus.INFEASIBLE, QPStatus.SOLVED]
    assert (out["charge_current"][:, 1] == 0).all()
    assert (out["action"][:, 1] == 0).all()


def test_blocked_way_home_is_infeasible_for_the_blocked_robot_only():
    # robot 0 has just enough energy to drive straight home at once; robot 1 stands in its way at contact distance
    world = make_world(n_agents=2, stations=[[0.9, 0.0], [-0.9, 0.0]], dtype="float64")
    geometry = world.homing
    position = torch.tensor([[[0.0, 0.0], [0.125, 0.0]]], dtype=F64)
    need = (
        world.energy_min + 2 * geometry.eps_energy + world.drain_rate / geometry.speed * (0.9 - geometry.reserve_radius)
    )
    energy = torch.tensor([[need, 0.9]], dtype=F64)
    nominal = torch.tensor([[[0.1, 0.0], [0.0, 0.0]]], dtype=F64)
    slot = torch.arange(2)[None]
    blocked = run(world, (nominal, position, energy, slot))
    assert blocked["status"][0].tolist() == [QPStatus.INFEASIBLE, QPStatus.SOLVED]
    assert blocked["action"][0, 0].tolist() == [0, 0]
    away = torch.tensor([[[0.0, 0.0], [-0.3, 0.0]]], dtype=F64)
    free = run(world, (nominal, away, energy, slot))
    assert free["status"][0, 0] == QPStatus.SOLVED
    assert free["action"][0, 0, 0] >= 0.9 * geometry.speed


@ALL_VARIANTS
@DIMENSIONS
def test_every_variant_is_finite_bounded_and_never_executes_an_unsolved_problem(variant, d):
    world = make_world(dimension=d)
    inputs = random_inputs(world, 9 if variant["split"] == "joint" else 90)
    out = run(world, inputs, **variant)
    assert all(value.isfinite().all() for value in out.values())
    assert out["action"].norm(dim=-1).max() <= SPEED
    assert ((out["charge_current"] >= 0) & (out["charge_current"] <= 1)).all()
    unsolved = out["status"] != QPStatus.SOLVED
    assert unsolved.any()
    assert (~unsolved).any()
    assert (out["action"][unsolved] == 0).all()
    assert torch.equal(out["level"], unsolved.long())
    assert (out["status"] != QPStatus.INACCURATE).all()
    cut = inputs[0] * (SPEED / inputs[0].norm(dim=-1, keepdim=True)).clamp(max=1)
    torch.testing.assert_close(out["correction"].squeeze(-1), (out["action"] - cut).norm(dim=-1), rtol=1e-4, atol=1e-6)


def test_inputs_that_are_missing_or_of_another_world_are_named():
    world = make_world()
    nominal, position, energy, slot = calm_inputs(world)
    full = {
        keys.NOMINAL_ACTION: nominal,
        keys.POSITION: position,
        keys.ENERGY: energy[..., None],
        keys.SLOT: slot[..., None],
    }
    for absent in full:
        td = TensorDict({key: value for key, value in full.items() if key != absent}, [4])
        with pytest.raises(KeyError, match=absent[-1]):
            SafetyFilter(SafetyConfig(mode="paper"), world)(td)
    for key, bad in (
        (keys.NOMINAL_ACTION, nominal[..., :1]),
        (keys.POSITION, position[:, :2]),
        (keys.ENERGY, energy),
        (keys.SLOT, slot[:, :2, None]),
        (keys.SLOT, slot[..., None].float()),
        (keys.POSITION, position.long()),
    ):
        with pytest.raises(ValueError, match=key[-1]):
            SafetyFilter(SafetyConfig(), world)(TensorDict(full, [4]).set(key, bad))
    td = SafetyFilter(SafetyConfig(mode="paper"), world)(TensorDict(full, [4]))
    assert td[keys.ACTION].shape == (4, 3, 2)
    for key in (
        keys.CHARGE_CURRENT,
        keys.CORRECTION,
        keys.BARRIER_ENERGY,
        keys.BARRIER_OVERCHARGE,
        keys.BARRIER_COLLISION,
    ):
        assert td[key].shape == (4, 3, 1)
    assert td[keys.STATUS].shape == td[keys.LEVEL].shape == (4, 3)
    assert td[keys.OUTSIDE].dtype == torch.bool
    assert td[keys.STATUS].dtype == td[keys.LEVEL].dtype == torch.int64


@DIMENSIONS
def test_diagnostics_are_the_literatures_barriers(d):
    world = make_world(dimension=d, dtype="float64")
    inputs = random_inputs(world, 12)
    _, position, energy, slot = inputs
    out = run(world, inputs)
    for b, i in itertools.product(range(12), range(3)):
        way = math.dist(position[b, i].tolist(), world.slot_positions[slot[b, i]])
        reserve = world.drain_rate / world.max_speed * max(0.0, way - world.break_even_radius)  # at full speed
        gaps = [math.dist(position[b, i].tolist(), position[b, j].tolist()) for j in range(3) if j != i]
        assert out["h_c"][b, i, 0].item() == pytest.approx(energy[b, i].item() - world.energy_min - reserve, abs=1e-12)
        assert out["h_o"][b, i, 0].item() == pytest.approx(world.energy_max - energy[b, i].item(), abs=1e-12)
        assert out["h_s"][b, i, 0].item() == pytest.approx(min(gaps) ** 2 - world.safety_distance**2, abs=1e-12)


# ---- a function of its inputs ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("split", ["half", "full", "joint"])
@DIMENSIONS
def test_filter_is_a_pure_function(split, d):
    world = make_world(dimension=d)
    inputs = random_inputs(world, 6 if split == "joint" else 30)
    before = [x.clone() for x in inputs]
    f = SafetyFilter(SafetyConfig(mode="paper", split=split), world)
    first = f.filter(*inputs)
    f.filter(*random_inputs(world, 3, seed=9))
    again = f.filter(*inputs)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(inputs, before, strict=True))


@pytest.mark.parametrize("split", ["half", "full", "joint"])
@DIMENSIONS
def test_order_of_the_robots_does_not_matter(split, d):
    world = make_world(n_agents=4, dimension=d, dtype="float64")
    inputs = random_inputs(world, 6 if split == "joint" else 30)
    order = torch.tensor([2, 0, 3, 1])
    out = run(world, inputs, split=split)
    permuted = run(world, tuple(x[:, order] for x in inputs), split=split)
    assert (out["correction"] > 1e-3).any()
    for name in set(out) - {"residual"}:
        torch.testing.assert_close(permuted[name], out[name][:, order], rtol=0, atol=1e-6, msg=name)


def test_any_batch_shape_and_a_single_robot():
    world = make_world(n_agents=1)
    inputs = random_inputs(world, 12)
    flat = run(world, inputs)
    shaped = run(world, tuple(x.unflatten(0, (3, 4)) for x in inputs))
    one = run(world, tuple(x[0] for x in inputs))
    for name, value in flat.items():
        assert torch.equal(shaped[name].flatten(0, 1), value), name
        assert torch.equal(one[name], value[0]), name


# ---- solvers and splits agree ----------------------------------------------------------------------------------------
@DIMENSIONS
def test_speed_polytope_is_inscribed_and_wide(d):
    normals, offset = speed_faces(d, SPEED)
    normals = torch.tensor(normals, dtype=F64)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals), dtype=F64))
    halfspaces = torch.cat([normals, torch.full((len(normals), 1), -offset, dtype=F64)], 1).numpy()
    corners = HalfspaceIntersection(halfspaces, torch.zeros(d, dtype=F64).numpy()).intersections
    widest = max(math.hypot(*corner) for corner in corners)
    assert widest <= SPEED * (1 + 1e-9)
    assert widest >= 0.96 * SPEED
    assert offset >= (0.98 if d == 2 else 0.9) * SPEED


@DIMENSIONS
def test_qpth_and_exact_agree_inside_the_polytope(d):
    world = make_world(dimension=d, dtype="float64")
    nominal, *rest = crowded_inputs(world, 60 if d == 2 else 24)
    inputs = (0.8 * nominal, *rest)
    exact, qpth = run(world, inputs), run(world, inputs, solver="qpth")
    inradius = speed_faces(d, SPEED)[1]
    solved = (exact["status"] == 0) & (qpth["status"] == 0)
    inside = solved & (exact["action"].norm(dim=-1) < inradius)
    assert (inside & (exact["correction"].squeeze(-1) > 1e-3)).sum() >= 10
    torch.testing.assert_close(qpth["action"][inside], exact["action"][inside], rtol=0, atol=1e-6)
    assert (qpth["correction"] >= exact["correction"] - 1e-7)[solved].all()  # a smaller set is never nearer
    assert (exact["status"][qpth["status"] == 0] == 0).all()  # nor ever larger
    assert torch.equal(qpth["charge_current"], exact["charge_current"])


def literal_rows(world, position, energy, alphas):
    """Residuals of the continuous-time rows, written by hand: functions of the velocities ``(B, N, d)``."""
    alpha_c, alpha_o, alpha_s = alphas
    slots, stations = (torch.tensor(x, dtype=F64) for x in (world.slot_positions, world.station_positions))
    radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}
    power = world.charge_rate * charging_field(position, stations, **radii)
    current = ((world.drain_rate + alpha_o * (world.energy_max - energy)) / power.clamp(min=1e-9)).clamp(0, 1)
    offset = position - slots
    way = offset.norm(dim=-1)
    slope = world.drain_rate / world.max_speed
    far = way > world.homing.charge_radius
    h_c = energy - world.energy_min - slope * (way - world.homing.charge_radius).clamp(min=0)
    i, j = torch.triu_indices(world.n_agents, world.n_agents, 1)
    q = position[:, i] - position[:, j]
    h_s = q.square().sum(-1) - world.safety_distance**2

    def energy_residual(u):
        rho_rate = torch.where(far, slope * (offset * u).sum(-1) / way, 0.0)
        return power * current - world.drain_rate - rho_rate + alpha_c * h_c

    def pair_residual(u):
        return 2 * (q * (u[:, i] - u[:, j])).sum(-1) + alpha_s * h_s

    return energy_residual, pair_residual


def crowded_inputs(world, batch=30):
    """Identity slots, positions close together but apart, energies above the reserve, nominal actions inwards."""
    n, d = world.n_agents, world.dimension
    slots = torch.tensor(world.slot_positions, dtype=F64)
    position = (0.075 + 0.06 * uniform(batch, n, 1, seed=1, dtype="float64")) * slots / slots.norm(dim=-1, keepdim=True)
    energy = 0.6 + 0.35 * uniform(batch, n, seed=2, dtype="float64")
    energy[: batch // 2] -= 0.28
    noise = 2 * uniform(batch, n, d, seed=3, dtype="float64") - 1
    nominal = -0.9 * SPEED * position / position.norm(dim=-1, keepdim=True) + 0.3 * SPEED * noise
    return nominal, position, energy, torch.arange(n).expand(batch, n)


@DIMENSIONS
def test_every_split_satisfies_the_rows_it_promises(d):
    world = make_world(dimension=d, dtype="float64", stations=[[0.9, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    inputs = crowded_inputs(world, 30 if d == 2 else 10)
    for split in ("half", "full", "joint"):
        out = run(world, inputs, split=split, sampled_data=False)
        solved = (out["status"] == 0).all(-1)
        energy_residual, pair_residual = literal_rows(
            world, *inputs[1:3], (0.2 / world.dt, 0.5 / world.dt, 1 / world.dt)
        )
        u = out["action"]
        assert solved.sum() >= 5
        assert energy_residual(u)[solved].min() >= -1e-6
        assert pair_residual(u)[solved].min() >= -1e-6
        if split != "joint":  # everybody does his part: all of the row at half the gain, or half of it at the full gain
            i, j = torch.triu_indices(3, 3, 1)
            others_static = pair_residual(torch.zeros_like(u)) / 2
            for robot in range(3):
                alone = torch.zeros_like(u)
                alone[:, robot] = u[:, robot]
                mine = (i == robot) | (j == robot)
                assert (pair_residual(alone) - others_static)[solved][:, mine].min() >= -1e-6
        cut = inputs[0] * (SPEED / inputs[0].norm(dim=-1, keepdim=True)).clamp(max=1)
        assert pair_residual(cut)[solved].min() < -1e-2  # the rows had something to say
        assert energy_residual(cut)[solved].min() < -1e-3


def test_joint_solution_costs_no_more_than_the_decentralised_one():
    world = make_world(dtype="float64", stations=[[0.9, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    inputs = crowded_inputs(world)
    for sampled in (True, False):
        half = run(world, inputs, split="half", solver="qpth", sampled_data=sampled)  # the same speed polygon
        joint = run(world, inputs, split="joint", sampled_data=sampled)
        solved = (half["status"] == 0).all(-1)
        assert solved.sum() >= 10
        assert (joint["status"][solved] == 0).all()
        costs = [out["correction"].square().sum((-2, -1))[solved] for out in (joint, half)]
        assert (costs[0] <= costs[1] + 1e-9).all()
        assert (costs[0] < costs[1] - 1e-6).any()


# ---- gradients -------------------------------------------------------------------------------------------------------
def jacobian(world, inputs, **safety):
    """d action / d nominal of one world, ``(N, d, N, d)``."""
    f, (nominal, *rest) = SafetyFilter(SafetyConfig(**{"mode": "paper", **safety}), world), inputs
    return torch.autograd.functional.jacobian(lambda x: f.filter(x, *rest)[0], nominal)


@DIMENSIONS
@pytest.mark.parametrize("split", ["half", "joint"])
def test_gradient_is_the_identity_where_nothing_is_corrected(d, split):
    world = make_world(dimension=d)
    n = world.n_agents
    full = jacobian(world, tuple(x[0] for x in calm_inputs(world)), split=split)
    assert torch.equal(full.reshape(n * d, n * d), torch.eye(n * d))


@pytest.mark.parametrize("d", [2, 3])
def test_gradient_is_a_projection_where_one_row_is_active(d):
    # two robots at contact distance: 0 pushes against 1, which slides away sideways
    world = make_world(n_agents=2, dimension=d, dtype="float64", stations=[[0.9, 0.0], [-0.9, 0.0]])
    direction = torch.tensor([0.6, 0.8] if d == 2 else [0.6, 0.64, 0.48], dtype=F64)
    position = torch.stack([torch.zeros(d, dtype=F64), 0.1225 * direction])
    nominal = 0.4 * SPEED * torch.stack([direction, direction])
    nominal[:, 0] += 0.02
    energy = torch.full((2,), 0.95, dtype=F64)
    full = jacobian(world, (nominal, position, energy, torch.arange(2)))
    projection = torch.eye(d, dtype=F64) - torch.outer(direction, direction)
    torch.testing.assert_close(full[0, :, 0], projection)
    torch.testing.assert_close(full[1, :, 1], torch.eye(d, dtype=F64))
    assert (full[0, :, 1] == 0).all()
    assert (full[1, :, 0] == 0).all()


@pytest.mark.parametrize("split", ["half", "full", "joint"])
def test_gradient_is_finite_everywhere_and_zero_where_held(split):
    world = make_world(dtype="float64")
    nominal, *rest = random_inputs(world, 12 if split == "joint" else 30)
    nominal = nominal.requires_grad_()
    nominal.data[0] = 0
    f = SafetyFilter(SafetyConfig(mode="paper", split=split), world)
    action, _, correction, status, *_ = f.filter(nominal, *rest)
    (action.sum() + correction.sum()).backward()
    assert nominal.grad.isfinite().all()
    assert (status != 0).any()
    nominal.grad = None
    f.filter(nominal, *rest)[0].sum().backward()
    assert (nominal.grad[status != 0] == 0).all()
    assert (nominal.grad[status == 0] != 0).any()


def test_joint_gradient_stays_with_the_own_nominal_and_the_value_is_the_same():
    world = make_world(dtype="float64", stations=[[0.9, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    inputs = crowded_inputs(world, 6)
    f = SafetyFilter(SafetyConfig(mode="paper", split="joint"), world)
    plain = f.filter(*inputs)
    graphed = f.filter(inputs[0].clone().requires_grad_(), *inputs[1:])
    for a, b in zip(plain, graphed, strict=True):
        torch.testing.assert_close(a, b.detach(), rtol=0, atol=1e-9)
    assert (plain[2] > 1e-3).all(-1).all(-1).any()  # everybody is corrected somewhere
    for world_index in range(6):
        full = jacobian(world, tuple(x[world_index] for x in inputs), split="joint")
        for i, j in itertools.permutations(range(3), 2):
            assert (full[i, :, j] == 0).all()
        assert all((full[i, :, i] != 0).any() for i in range(3))


# ---- configurations --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["alpha_c", "alpha_o", "alpha_s"])
def test_gain_beyond_one_over_dt_is_refused(name):
    world = make_world(dt=0.2)
    SafetyFilter(SafetyConfig(mode="paper", **{name: 5.0}), world)
    for gain in (5.1, 0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=rf"safety\.{name}={gain}.*\(0, 5\.0\].*alpha dt must not exceed 1"):
            SafetyFilter(SafetyConfig(mode="paper", **{name: gain}), world)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"composition": "min"}, r"safety\.sampled_data=true needs safety\.composition=stacked"),
        ({"split": "joint", "solver": "exact"}, r"safety\.solver='exact'.*safety\.split='joint'"),
        ({"mode": "nothing"}, r"safety\.mode='nothing'.*certified, paper, dalal, none"),
        ({"split": "third"}, r"safety\.split='third'.*anchor, half, full, joint"),
        ({"split": "anchor"}, r"safety\.split=anchor does not fit safety\.mode=paper.*half, full, joint"),
        (
            {"mode": "certified", "split": "joint"},
            r"safety\.split=joint does not fit safety\.mode=certified.*anchor, half",
        ),
        ({"mode": "certified", "composition": "min"}, r"safety\.mode=certified.*safety\.composition=min"),
        ({"mode": "certified", "sampled_data": False}, r"safety\.mode=certified.*safety\.sampled_data=False"),
        ({"composition": "max", "sampled_data": False}, r"safety\.composition='max'.*stacked, min"),
        ({"solver": "osqp"}, r"safety\.solver='osqp'.*auto, exact, active_set, pdipm, qpth"),
    ],
)
def test_configuration_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        SafetyConfig(**{"mode": "paper", **fields})


def test_default_gains_follow_the_step():
    world = make_world(dt=0.1)
    assert SafetyConfig(mode="paper").gains(world) == pytest.approx((2, 5, 10, 10))
    assert SafetyConfig(mode="paper", split="full").gains(world) == pytest.approx((2, 5, 5, 10))
    assert SafetyConfig(mode="paper", alpha_s=3.0).gains(world) == pytest.approx((2, 5, 3, 10))


# ---- in the world ----------------------------------------------------------------------------------------------------
def docked_energy(*, filtered, steps=160, **fields):
    """Energies of robots that stay in their slots, ``(steps, B, N)``."""
    world = make_world(on_violation="continue", **fields)
    env = SurveillanceEnv(world, 8, seed=0)
    slots = env.slots[: world.n_agents].expand(8, -1, -1)
    energy = 0.5 + 0.4 * uniform(8, world.n_agents, 1, seed=0)
    td = env.set_state(slots, energy, torch.arange(world.n_agents).view(1, -1, 1))
    f, rows = SafetyFilter(SafetyConfig(mode="paper"), world), []
    for _ in range(steps):
        td[keys.NOMINAL_ACTION] = torch.zeros_like(td[keys.POSITION])
        td = f(td) if filtered else td.set(keys.ACTION, td[keys.NOMINAL_ACTION])
        td = step_mdp(env.step(td))
        rows.append(td[keys.ENERGY].squeeze(-1))
    return world, torch.stack(rows)


def test_docked_robots_fill_up_and_never_overcharge():
    world, energy = docked_energy(filtered=True)
    assert energy.max() <= world.energy_max - 0.5 * world.homing.eps_energy  # a rounding margin is kept
    assert energy[-1].min() >= world.energy_max - 0.001
    assert (energy[1:] - energy[:-1]).min() >= -1e-6
    _, unfiltered = docked_energy(filtered=False, steps=20)
    assert unfiltered.max() > world.energy_max


def test_docked_robots_with_expensive_motion_never_overcharge():
    world, energy = docked_energy(filtered=True, steps=80, drain_per_speed=0.1, drain_per_speed_squared=0.2)
    assert energy.max() <= world.energy_max
    assert energy[-1].min() >= world.energy_max - 0.001


def measure(controller, *, n_agents=3, worlds=32, steps=200, **safety):
    """Counted violations of a controller behind a filter, and all metrics."""
    world = SurveillanceConfig(n_agents=n_agents, on_violation="continue")
    policy = TensorDictSequential(
        make_controller(controller, world, seed=2), SafetyFilter(SafetyConfig(**{"mode": "paper", **safety}), world)
    )
    metrics, statistics, _ = evaluate_policy(SurveillanceEnv(world, worlds, seed=1), policy, steps)
    return metrics["violations"], metrics, statistics


def test_careful_controller_survives_behind_the_default_filter():
    violations, metrics, statistics = measure("charge_when_low", worlds=64)
    assert sum(violations.values()) == 0
    assert metrics["robot_steps"] == 64 * 200 * 3
    assert metrics["charges_per_robot"] >= 1
    assert statistics["fallback_rate"] == 0


def test_filter_is_what_keeps_random_robots_alive():
    unfiltered, *_ = measure("random", n_agents=5, mode="none")
    assert all(unfiltered[kind] > 100 for kind in ("stranded", "overcharged", "collision", "depleted"))
    filtered, _, statistics = measure("random", n_agents=5)
    assert sum(filtered.values()) < 0.05 * sum(unfiltered.values())
    assert filtered["collision"] == filtered["overcharged"] == 0
    assert statistics["intervention_rate"] > 0.02


def test_default_filter_lets_three_random_robots_live():
    violations, *_ = measure("random", worlds=64)
    assert sum(violations.values()) == 0


def test_literal_filter_violates():
    violations, _, statistics = measure("random", n_agents=5, worlds=64, **LITERAL)
    assert violations["stranded"] > 100
    assert violations["collision"] > 10
    assert violations["overcharged"] > 10
    assert statistics["infeasible"] > 0


@pytest.mark.parametrize("mode", ["certified", "paper"])
@pytest.mark.parametrize(
    ("of", "dtype"), [(0, torch.float64), (0, torch.int64), (0, torch.float16), (2, torch.float64)]
)
def test_other_number_types_are_converted_to_the_positions(mode, of, dtype):
    world = make_world()
    inputs = list(random_inputs(world, 4))
    inputs[0] = inputs[0].round() if dtype == torch.int64 else inputs[0]
    expected = run(world, inputs, mode=mode)
    inputs[of] = inputs[of].to(dtype)
    got = run(world, inputs, mode=mode)
    assert got["action"].dtype == torch.float32
    tolerance = 1e-3 if dtype == torch.float16 else 0
    torch.testing.assert_close(got["action"], expected["action"], rtol=0, atol=tolerance)


@pytest.mark.parametrize("mode", ["certified", "paper"])
def test_nan_nominal_action_has_no_nan_gradient(mode):
    world = make_world()
    nominal, *rest = random_inputs(world, 4)
    nominal[0, 0] = math.nan
    nominal.requires_grad_()
    f = SafetyFilter(SafetyConfig(mode=mode), world)
    action, _, correction, *_ = f.filter(nominal, *rest)
    (action.square().sum() + correction.square().sum()).backward()
    assert nominal.grad.isfinite().all()
    assert (nominal.grad[0, 0] == 0).all()
