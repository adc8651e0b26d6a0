"""Adversaries: that each does the harm it is meant to do, and that only the certified filter stands it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from agents import make_controller
from agents.adversaries import ADVERSARIES, MEMBERS
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.dynamics import pair_indices
from envs.homing import closest_approach
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)
F64 = torch.float64
LITERAL = {"mode": "paper", "composition": "min", "split": "full", "sampled_data": False}


def make_world(**fields):
    return SurveillanceConfig(**({"horizon": 0, "on_violation": "continue", "dtype": "float64"} | fields))


def states(world, *batch, seed=0):
    """Start states of any batch shape, without the environment's other keys."""
    td = SurveillanceEnv(world, torch.Size(batch).numel(), seed=seed).reset()
    return td.select(keys.POSITION, keys.ENERGY, keys.SLOT).reshape(batch)


def act(controller, td):
    return controller(td.clone())[keys.NOMINAL_ACTION]


def moved(td, action, dt):
    """Robots moved freely, batteries untouched."""
    return td.clone().set(keys.POSITION, td[keys.POSITION] + dt * action)


def rollout(controller, td, world, steps):
    """Positions and actions ``(T, *B, N, d)`` of robots that move freely."""
    positions, actions = [], []
    for _ in range(steps):
        action = act(controller, td)
        positions.append(td[keys.POSITION])
        actions.append(action)
        td = moved(td, action, world.dt)
    return torch.stack(positions), torch.stack(actions)


def slot_places(world, td):
    return torch.tensor(world.slot_positions, dtype=world.torch_dtype)[td[keys.SLOT].squeeze(-1)]


def speed(action):
    return action.norm(dim=-1)


# ---- all of them -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ADVERSARIES)
@pytest.mark.parametrize(
    ("n", "d", "batch", "dtype"),
    [(3, 2, (4,), "float32"), (1, 2, (4,), "float32"), (4, 3, (2, 3), "float64"), (2, 3, (), "float32")],
)
def test_action_fits_the_state_and_is_repeated_by_the_same_seed(name, n, d, batch, dtype):
    world = make_world(n_agents=n, dimension=d, dtype=dtype)
    runs = []
    for seed in (5, 5):
        td = states(world, *batch)
        start = td[keys.POSITION].clone()
        _, actions = rollout(make_controller(name, world, seed), td, world, 4 if name != "nan" else 1)
        assert torch.equal(td[keys.POSITION], start)  # the states are only read
        runs.append(actions)
    first, again = runs
    assert first.shape[1:] == (*batch, n, d)
    assert first.dtype == world.torch_dtype
    assert torch.equal(first.nan_to_num(nan=7.0), again.nan_to_num(nan=7.0))
    if name != "nan":
        assert first.isfinite().all()
        assert speed(first).max() > 0.02
    if name not in ("nan", "chatter", "mixture"):
        assert speed(first).max() <= world.max_speed * (1 + 1e-6)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("name", ADVERSARIES)
def test_memory_starts_afresh_with_another_batch(name, device):
    world = make_world(n_agents=2)
    controller, torch_state = make_controller(name, world), torch.get_rng_state()
    for batch in ((3,), (2, 2), (), (3,)):
        action = act(controller, states(world, *batch).to(device))
        assert action.shape == (*batch, 2, 2)
        assert action.device.type == device
    assert torch.equal(torch.get_rng_state(), torch_state)  # own generator only


# ---- what each does --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("docked", [False, True])
def test_flee_gains_distance_and_ends_in_a_corner(d, docked):
    world = make_world(dimension=d)
    td = states(world, 50)
    slots = slot_places(world, td)
    if docked:
        td[keys.POSITION] = slots
    positions, actions = rollout(make_controller("flee", world), td, world, 150)
    bounds = torch.tensor(world.bounds, dtype=F64)
    step = world.max_speed * world.dt
    inside = ((positions >= bounds[:, 0] - step) & (positions <= bounds[:, 1] + step)).all(dim=-1)
    way = (positions - slots).norm(dim=-1)
    assert (way[1:] - way[:-1]).min() > 0
    torch.testing.assert_close(speed(actions), torch.full(way.shape, world.max_speed, dtype=F64))  # never stops
    corner = ((positions - bounds.mean(-1)).abs() >= 1 - 1.01 * step).all(dim=-1)
    assert (corner | inside).all()
    assert corner.any(dim=0).all()


def test_gather_narrows_the_team_and_changes_its_mind():
    world = make_world(n_agents=5)
    positions, _ = rollout(make_controller("gather", world), states(world, 50), world, 150)
    spread = (positions - positions.mean(-2, keepdim=True)).norm(dim=-1).amax(dim=-1)
    assert spread[60:].mean() < 0.4 * spread[0].mean()
    late = positions.mean(-2)[60:]
    assert (late.amax(0) - late.amin(0)).norm(dim=-1).median() > 0.5


def test_swap_exchanges_places_through_each_other():
    world = make_world(n_agents=4)
    td = states(world, 200, seed=3)
    controller = make_controller("swap", world)
    act(controller, td)
    goal, start = controller._memory["goal"], td[keys.POSITION]
    opposite = torch.isclose(goal, -start).all(-1)
    gap = (goal.unsqueeze(-2) - start.unsqueeze(-3)).norm(dim=-1)
    partner = gap.argmin(dim=-1)
    exchanged = (
        (gap.amin(dim=-1) == 0) & (partner.gather(-1, partner) == torch.arange(4)) & (partner != torch.arange(4))
    )
    assert (opposite | exchanged).all()
    assert 50 < opposite.all(-1).sum() < 150
    positions, _ = rollout(controller, td, world, 150)
    i, j = pair_indices(4)
    gap = (positions[:, :, i] - positions[:, :, j]).norm(dim=-1)
    assert (gap.amin(0).amin(-1) < world.safety_distance).double().mean() > 0.95  # somebody is run through
    assert (controller._memory["goal"] != goal).any(-1).any(-1).double().mean() > 0.8  # and again


@pytest.mark.parametrize("d", [2, 3])
def test_chatter_reverses_turns_and_asks_for_too_much(d):
    world = make_world(dimension=d)
    td = states(world, 100)
    controller = make_controller("chatter", world)
    actions = torch.stack([act(controller, td) for _ in range(30)])
    assert set((speed(actions) / world.max_speed).round().unique().tolist()) == {1.0, 1000.0}
    heading = actions / speed(actions).unsqueeze(-1)
    cosine = (heading[1:] * heading[:-1]).sum(-1)
    for angle, share in ((-1, 0.675), (1, 0.225), (0, 0.1)):
        assert ((cosine - angle).abs() < 1e-9).double().mean() == pytest.approx(share, abs=0.03)


def test_block_sits_in_another_robots_dock_or_on_its_way():
    world = make_world()
    td = states(world, 200)
    controller = make_controller("block", world)
    act(controller, td)
    victim, share = controller._memory["victim"], controller._memory["share"].unsqueeze(-1)
    assert (victim != torch.arange(3)).all()
    assert 0.4 < (share == 0).double().mean() < 0.6
    slots = slot_places(world, td)
    wide = victim.unsqueeze(-1).expand_as(slots)
    docks = slots.gather(-2, wide)
    place = docks + share * (td[keys.POSITION].gather(-2, wide) - docks)
    before = (td[keys.POSITION] - place).norm(dim=-1)
    after = (moved(td, act(controller, td), world.dt)[keys.POSITION] - place).norm(dim=-1)
    kept = (victim == controller._memory["victim"]) & (share[..., 0] == controller._memory["share"])
    expected = (before - world.dt * world.max_speed).clamp_min(0)
    torch.testing.assert_close(after[kept], expected[kept], rtol=0, atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_tangential_is_at_right_angles_to_the_way_home(d):
    world = make_world(dimension=d)
    td = states(world, 50)
    positions, actions = rollout(make_controller("tangential", world), td, world, 20)
    offset = positions - slot_places(world, td)
    assert ((offset * actions).sum(-1) / (offset.norm(dim=-1) * speed(actions))).abs().max() < 1e-9
    torch.testing.assert_close(speed(actions), torch.full(actions.shape[:-1], world.max_speed, dtype=F64))
    grown = (offset.square().sum(-1)[-1] - offset.square().sum(-1)[0]) / (world.max_speed * world.dt) ** 2
    torch.testing.assert_close(grown, torch.full_like(grown, 19))  # the sampled orbit spirals outwards


def test_chase_closes_in_on_the_nearest():
    world = make_world()
    td = states(world, 100)
    start, action = td[keys.POSITION], act(make_controller("chase", world), td)
    gap = torch.cdist(start, start) + torch.diag(torch.full((3,), torch.inf))
    nearest = gap.argmin(dim=-1, keepdim=True)
    theirs = start.gather(-2, nearest.expand_as(start))  # the hunted stands still
    closer = gap.amin(-1) - (start + 1e-3 * action - theirs).norm(dim=-1)
    torch.testing.assert_close(closer, torch.full_like(closer, 1e-3 * world.max_speed), rtol=1e-6, atol=0)


@pytest.mark.parametrize("reserve", ["linear", "logarithmic"])
@pytest.mark.parametrize("d", [2, 3])
def test_certificate_descent_is_the_steepest(d, reserve):
    world = make_world(n_agents=4, dimension=d, reserve=reserve, drain_rate=0.015)
    td = states(world, 60, seed=4)
    position, slots = td[keys.POSITION], slot_places(world, td)
    action = act(make_controller("certificate_descent", world), td)
    pairs, eps = torch.stack(pair_indices(4)), 1e-6
    agree = []
    for robot in range(4):
        own = (pairs == robot).any(dim=0)

        def gap(shift, robot=robot, own=own):
            other = position.clone()
            other[:, robot] += shift
            return closest_approach(other, slots, world.homing)[:, own]

        axes = [(gap(eps * e) - gap(-eps * e)) / (2 * eps) for e in torch.eye(d, dtype=F64)]
        slope = torch.stack(axes, dim=-1)  # (B, 3, d)
        index = torch.where(slope.norm(dim=-1) > 1e-3, gap(0.0), torch.inf).argmin(dim=-1)
        worlds = torch.arange(60)
        slope = slope[worlds, index]
        steepest = -world.max_speed * slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        some = slope.norm(dim=-1) > 1e-3
        agree.append(((steepest - action[:, robot]).norm(dim=-1) < 1e-4)[some])
        lower = (gap(1e-4 * action[:, robot]) - gap(0.0))[worlds, index][some]
        assert (lower < 0).double().mean() > 0.98
    assert len(torch.cat(agree)) > 120
    assert torch.cat(agree).double().mean() > 0.98  # not at the kinks of G


def test_ou_is_correlated_and_saturates():
    world = make_world()
    controller, td = make_controller("ou", world), states(world, 100)
    actions = torch.stack([act(controller, td) for _ in range(120)])

    def correlation(lag):
        return float(((actions[lag:] * actions[: len(actions) - lag]).sum(-1).mean()) / speed(actions).square().mean())

    assert correlation(1) > 0.9
    assert 0.2 < correlation(30) < 0.5
    assert abs(correlation(110)) < 0.2
    assert (speed(actions) > 0.999 * world.max_speed).double().mean() > 0.5


def test_mixture_holds_several_kinds_and_changes_them():
    world = make_world()
    controller, td = make_controller("mixture", world), states(world, 100)
    act(controller, td)
    first = controller._memory["kind"]
    assert len(first.unique()) == len(MEMBERS)
    flee, fleeing = act(make_controller("flee", world), td), first == list(MEMBERS).index("flee")
    action = act(controller, td)
    fleeing &= controller._memory["kind"] == first
    assert torch.equal(action[fleeing], flee[fleeing])
    assert fleeing.sum() > 10
    assert 0 < (controller._memory["kind"] != first).double().mean() < 0.1


def test_nan_holds_every_kind_of_broken_number():
    world = make_world(dtype="float32")
    action = act(make_controller("nan", world), states(world, 400))
    for broken in (action.isnan(), action == torch.inf, action == -torch.inf, action == 1e30):
        assert (broken.sum(-1) == 1).any()  # one component
        assert broken.all(-1).any()  # the whole vector
    healthy = (action.abs() <= world.max_speed).all(-1)
    assert 0.6 < healthy.double().mean() < 0.9


# ---- vacuity: the harm is real, and the certified filter prevents it -------------------------------------------------
def harm(steps, **safety):
    """Violating robot-steps by adversary; each has its own share of the worlds of one environment."""
    world = make_world(dtype="float32")
    share = 4
    env = SurveillanceEnv(world, share * len(ADVERSARIES), seed=7)
    controllers = [make_controller(name, world, seed=1) for name in ADVERSARIES]
    guard, td = SafetyFilter(SafetyConfig(**safety), world), env.reset()
    count = torch.zeros(len(ADVERSARIES), dtype=torch.int64)
    for _ in range(steps):
        parts: list[TensorDict] = [part.clone() for part in td.split(share)]
        actions = [controller(part)[keys.NOMINAL_ACTION] for controller, part in zip(controllers, parts, strict=True)]
        td = env.step(guard(td.set(keys.NOMINAL_ACTION, torch.cat(actions))))
        flags = torch.stack([td["next", *keys.VIOLATION, kind] for kind in keys.VIOLATION_KINDS])
        count += flags.sum((0, -1, -2)).view(-1, share).sum(-1)
        td = step_mdp(td)
    return dict(zip(ADVERSARIES, count.tolist(), strict=True))


@pytest.mark.parametrize(("safety", "steps"), [({"mode": "none"}, 80), (LITERAL, 80)], ids=["none", "literal"])
def test_adversaries_do_harm_without_the_certified_filter(safety, steps):
    count = harm(steps, **safety)
    assert min(count.values()) > 0, count


def test_certified_filter_stands_every_adversary():
    assert set(harm(120).values()) == {0}
