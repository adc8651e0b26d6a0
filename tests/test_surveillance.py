"""The environment: specs, seeds, masks, flags, raw states, certified starts, checkpoints, observation field by field."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.homing import is_certified

FAMILIES = {
    "uniform": {"density": "uniform"},
    "fixed": {"density": "gaussian_mixture"},
    "drawn": {"density": "gaussian_mixture", "density_per_world": True},
    "moving": {"density": "moving"},
    "age": {"density": "age"},
}
FLAGS = ("done", "terminated", "truncated")


class Wanderer:
    """A policy of its own random stream; actions reach far outside the speed ball, currents outside [0, 1]."""

    def __init__(self, config, seed=0, scale=1.0):
        self.config, self.scale = config, scale
        self.generator = torch.Generator().manual_seed(seed)

    def __call__(self, td):
        position = td[keys.POSITION]
        noise = torch.randn(position.shape, generator=self.generator, dtype=position.dtype)
        td[keys.ACTION] = self.scale * self.config.max_speed * noise
        td[keys.CHARGE_CURRENT] = 1.5 * torch.rand(
            td[keys.ENERGY].shape, generator=self.generator, dtype=position.dtype
        )
        return td


def make(num_envs=4, seed=0, **changes):
    return SurveillanceEnv(SurveillanceConfig(**changes), num_envs=num_envs, seed=seed)


def wander(env, steps=30, seed=0, scale=1.0, **kwargs):
    return env.rollout(steps, Wanderer(env.config, seed, scale), break_when_any_done=False, **kwargs)


def step(env, velocity=None, current=None):
    """One transition from the environment's present state; robots stand still by default."""
    config = env.config
    shape = (env.batch_size[0], config.n_agents)
    velocity = torch.zeros(*shape, config.dimension) if velocity is None else torch.as_tensor(velocity)
    td = TensorDict({keys.ACTION: velocity.to(config.torch_dtype).expand(*shape, -1)}, env.batch_size)
    if current is not None:
        td[keys.CHARGE_CURRENT] = torch.as_tensor(current, dtype=config.torch_dtype).expand(*shape, 1)
    return env.step(td)["next"]


def place(env, position, energy=0.9, slot=None):
    """Put the same hand-made state into every world."""
    shape = (env.batch_size[0], env.config.n_agents)
    position = torch.as_tensor(position, dtype=env.config.torch_dtype).expand(*shape, env.config.dimension)
    energy = torch.as_tensor(energy, dtype=env.config.torch_dtype).reshape(-1, 1).expand(*shape, 1)
    slot = None if slot is None else torch.as_tensor(slot).reshape(-1, 1).expand(*shape, 1)
    return env.set_state(position, energy, slot)


def assert_same(a, b, skip=()):
    names = set(a.keys(True, True))
    assert names == set(b.keys(True, True))
    for name in names - set(skip):
        assert torch.equal(a[name], b[name]), name


# ---- specs --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("d", "dtype"), [(2, "float32"), (3, "float64")])
def test_specs_hold_for_every_density(family, d, dtype):
    env = make(num_envs=3, dimension=d, dtype=dtype, observe_centroid=d == 3, **FAMILIES[family])
    check_env_specs(env, seed=0)
    td = env.rollout(3)
    for name in (keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.REWARD, keys.COVERAGE_COST):
        assert td["next", name].dtype == getattr(torch, dtype)


@pytest.mark.parametrize("changes", [{"n_agents": 1}, {"n_agents": 2}, {"n_agents": 8}, {"horizon": 0}, {"slots": 2}])
@pytest.mark.parametrize("num_envs", [1, 5])
def test_specs_hold_for_every_size(changes, num_envs):
    env = make(num_envs=num_envs, **changes)
    check_env_specs(env, seed=0)
    n = env.config.n_agents
    td = env.rollout(2)["next"]
    shapes = {
        keys.POSITION: (n, 2),
        keys.ENERGY: (n, 1),
        keys.SLOT: (n, 1),
        keys.REWARD: (n, 1),
        keys.COVERAGE_COST: (1,),
        keys.OBSERVATION: (n, env.n_observation),
        **{(*keys.VIOLATION, kind): (n, 1) for kind in keys.VIOLATION_KINDS},
        **dict.fromkeys(FLAGS, (1,)),
        **{(keys.AGENTS, flag): (n, 1) for flag in FLAGS},
    }
    for name, shape in shapes.items():
        assert td[name].shape[2:] == shape, name
    assert td[keys.SLOT].dtype == torch.int64
    assert td[(*keys.VIOLATION, "collision")].dtype == torch.bool


def test_no_worlds_are_refused():
    with pytest.raises(ValueError, match="num_envs=0"):
        SurveillanceEnv(SurveillanceConfig(), num_envs=0)


# ---- random streams -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("family", ["fixed", "drawn", "moving"])
def test_a_seed_fixes_the_rollout_bit_for_bit(family):
    changes = FAMILIES[family] | {"horizon": 12}
    first, again, other = (wander(make(seed=s, **changes), 40) for s in (3, 3, 4))
    assert_same(first, again)
    assert not torch.equal(first[keys.POSITION][:, 0], other[keys.POSITION][:, 0])
    assert first["next", "done"].sum() >= 8  # resets within the rollout


def test_set_seed_and_the_global_generator():
    env = make(seed=0)
    env.set_seed(9)
    first = env.reset()
    torch.manual_seed(123)  # the worlds draw from their own generator only
    torch.rand(7)
    env.set_seed(9)
    assert_same(first, env.reset())
    assert not torch.equal(first[keys.POSITION], env.reset()[keys.POSITION])


def test_worlds_start_apart():
    position = make(num_envs=16).reset()[keys.POSITION]
    for a in range(16):
        for b in range(a):
            assert (position[a] - position[b]).abs().max() > 1e-3


# ---- reset by mask ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("family", ["drawn", "age"])
def test_partial_reset_touches_only_the_masked_worlds(family):
    env = make(num_envs=6, seed=1, **FAMILIES[family])
    before = step_mdp(wander(env, 7, scale=0.3)[:, -1])
    mask = torch.tensor([True, False, False, True, False, True])
    state = env.state_dict()["state"]
    after = env.reset(before.clone().set("_reset", mask.unsqueeze(-1)))
    for name in (keys.POSITION, keys.ENERGY, keys.SLOT, keys.OBSERVATION, keys.COVERAGE_COST, keys.DENSITY):
        assert torch.equal(after[name][~mask], before[name][~mask]), name
    now = env.state_dict()["state"]
    for name in state:
        assert torch.equal(now[name][~mask], state[name][~mask]), name
    assert (after[keys.STEP_COUNT][mask] == 0).all()
    assert (after[keys.STEP_COUNT][~mask] == 7).all()
    assert ((after[keys.POSITION] != before[keys.POSITION]).flatten(1).any(-1) == mask).all()
    assert not after["done"][mask].any()


def test_rollout_resets_each_world_at_its_own_end():
    td = wander(make(num_envs=8, horizon=9, seed=2), 60)
    done = td["next", "done"].squeeze(-1)
    count = td[keys.STEP_COUNT].squeeze(-1)
    assert done.any()
    lengths = set()
    for b in range(8):
        steps = 0
        for t in range(60):
            assert int(count[b, t]) == steps
            assert int(td["next", keys.STEP_COUNT][b, t]) == steps + 1
            steps = 0 if done[b, t] else steps + 1
            if done[b, t]:
                lengths.add(int(count[b, t]) + 1)
            elif t < 59:  # the next root is this step's next
                assert torch.equal(td[keys.POSITION][b, t + 1], td["next", keys.POSITION][b, t])
                assert torch.equal(td[keys.SLOT][b, t + 1], td["next", keys.SLOT][b, t])
    assert 9 in lengths
    assert len(lengths) > 1


# ---- flags --------------------------------------------------------------------------------------------------------------
def independent_flags(config, position, next_position, next_energy, slots):
    """The definitions of DESIGN section 6 in numpy, one world and robot at a time."""
    batch, n = next_energy.shape
    out = {kind: np.zeros((batch, n), dtype=bool) for kind in keys.VIOLATION_KINDS}
    for b in range(batch):
        for i in range(n):
            energy = next_energy[b, i]
            way = min(math.dist(next_position[b, i], s) for s in slots)
            cost = config.drain_rate * max(0.0, way - config.break_even_radius) / config.max_speed
            out["depleted"][b, i] = energy < config.energy_min
            out["overcharged"][b, i] = energy > config.energy_max
            out["stranded"][b, i] = energy - config.energy_min < cost
            for j in range(n):
                if j != i:
                    start = position[b, i] - position[b, j]
                    move = next_position[b, i] - next_position[b, j] - start
                    t = min(1.0, max(0.0, -(start @ move) / max(move @ move, 1e-300)))
                    out["collision"][b, i] |= np.linalg.norm(start + t * move) < config.safety_distance
    return out


@pytest.mark.parametrize("on_violation", ["terminate", "continue"])
def test_flags_follow_from_the_stored_states(on_violation):
    env = make(num_envs=12, n_agents=6, dtype="float64", on_violation=on_violation, seed=3, drain_rate=0.12)
    td = wander(env, 60)
    flat = [td[keys.POSITION], td["next", keys.POSITION], td["next", keys.ENERGY].squeeze(-1)]
    expected = independent_flags(env.config, *(x.flatten(0, 1).numpy() for x in flat), env.slots.numpy())
    for kind in keys.VIOLATION_KINDS:
        got = td[("next", *keys.VIOLATION, kind)].flatten(0, 1).squeeze(-1).numpy()
        assert expected[kind].any() or (kind, on_violation) == ("depleted", "terminate"), kind
        assert (got == expected[kind]).all(), kind
    violated = np.stack(list(expected.values())).any((0, 2)).reshape(12, 60, 1)
    terminated = td["next", "terminated"].numpy()
    assert (terminated == (violated if on_violation == "terminate" else False)).all()
    assert (td["next", "truncated"].numpy() == (td["next", keys.STEP_COUNT].numpy() >= 100)).all()
    assert torch.equal(td["next", "done"], td["next", "terminated"] | td["next", "truncated"])
    for flag in FLAGS:
        assert torch.equal(td["next", keys.AGENTS, flag].squeeze(-1), td["next", flag].expand(-1, -1, 6))


def test_time_limit_truncates_and_never_terminates():
    env = make(horizon=3, n_agents=2)
    place(env, env.slots, 0.5, [0, 1])
    outs = [step(env, current=0.3) for _ in range(3)]
    assert [bool(o["truncated"].all()) for o in outs] == [False, False, True]
    assert [bool(o["truncated"].any()) for o in outs] == [False, False, True]
    assert not any(o["terminated"].any() for o in outs)
    assert outs[2]["done"].all()


def test_without_a_horizon_nothing_is_truncated():
    env = make(horizon=0, n_agents=2)
    place(env, env.slots, 0.5, [0, 1])
    for _ in range(150):
        out = step(env, current=1 / 6)  # the accepted charge is the drain
        assert not out["done"].any()
    assert out[keys.ENERGY].sub(0.5).abs().max() < 1e-4


def test_violation_terminates_its_own_world_only():
    env = make(num_envs=3, n_agents=2)
    td = place(env, env.slots, 0.5, [0, 1])
    position, energy = td[keys.POSITION], td[keys.ENERGY].clone()
    energy[1, 0] = 0.105  # the step drains 0.012
    env.set_state(position, energy)
    out = step(env, current=0)
    assert out["terminated"].squeeze(-1).tolist() == [False, True, False]
    assert not out["truncated"].any()
    assert out[(*keys.VIOLATION, "depleted")].squeeze(-1).tolist() == [[False, False], [True, False], [False, False]]
    assert out[keys.AGENTS, "terminated"].squeeze(-1).tolist() == [[False, False], [True, True], [False, False]]


def test_drained_robot_stands_still_and_keeps_counting():
    env = make(num_envs=2, n_agents=2, on_violation="continue")
    place(env, [[0.0, 0.0], [0.4, 0.4]], [0.105, 0.9], [0, 1])
    velocity = torch.tensor([[0.1, 0.05], [-0.1, 0.0]])
    first = step(env, velocity)  # still above the limit when the step starts
    assert torch.allclose(first[keys.POSITION][:, 0], torch.tensor([0.02, 0.01]))
    counts = [first[(*keys.VIOLATION, "depleted")].sum()]
    for _ in range(4):
        out = step(env, velocity)
        assert torch.equal(out[keys.POSITION][:, 0], first[keys.POSITION][:, 0])
        counts.append(out[(*keys.VIOLATION, "depleted")].sum())
        assert not out["done"].any()
    assert counts == [2] * 5  # robot 0 of both worlds, every step
    assert torch.allclose(out[keys.POSITION][:, 1], torch.tensor([0.4 - 5 * 0.02, 0.4]))  # the other drives on
    assert torch.allclose(out[keys.ENERGY][:, 0], torch.tensor(0.105 - 5 * 0.012))


# ---- the raw next state ---------------------------------------------------------------------------------------------------
def test_walls_do_not_stop_a_robot():
    env = make(n_agents=1)
    place(env, [[0.99, 0.5]])
    out = step(env, [[0.2, 0.0]])
    assert torch.allclose(out[keys.POSITION], torch.tensor([1.03, 0.5]))


def test_battery_above_its_limit_appears_and_is_flagged():
    env = make(n_agents=1)
    place(env, env.slots, 0.99)
    out = step(env)
    assert torch.allclose(out[keys.ENERGY], torch.tensor(0.99 + 0.2 * (0.36 - 0.06)))
    assert out[(*keys.VIOLATION, "overcharged")].all()
    assert out["terminated"].all()


@pytest.mark.parametrize("factor", [0.5, 1.0, 40.0])
def test_action_is_cut_to_the_speed_ball(factor):
    env = make(n_agents=1, dtype="float64")
    place(env, [[0.0, 0.0]])
    out = step(env, [[0.12 * factor, -0.16 * factor]])
    expected = np.array([0.12, -0.16]) * 0.2 * min(1.0, factor)
    np.testing.assert_allclose(out[keys.POSITION][0, 0].numpy(), expected, rtol=2e-6 if factor > 1 else 1e-7)


@pytest.mark.parametrize(("current", "accepted"), [(None, 1.0), (1.0, 1.0), (0.25, 0.25), (0.0, 0.0), (-1, 0), (3, 1)])
def test_absent_current_is_full_current(current, accepted):
    env = make(n_agents=1, dtype="float64", drain_per_speed=0.1)
    start = env.slots + torch.tensor([[0.0, 0.18]])  # the field is 1/2 in the middle between the radii
    place(env, start, 0.5)
    out = step(env, [[0.1, 0.0]], current)
    expected = 0.5 + 0.2 * (0.36 * 0.5 * accepted - 0.06 - 0.1 * 0.1)
    np.testing.assert_allclose(out[keys.ENERGY].numpy(), expected, atol=1e-12)


def test_not_a_number_is_a_violation():
    env = make(num_envs=1, n_agents=3)
    place(env, env.slots, 0.5, [0, 1, 2])
    velocity = torch.zeros(3, 2)
    velocity[1, 0] = float("nan")
    out = step(env, velocity)
    assert out["terminated"].all()
    assert out[(*keys.VIOLATION, "collision")].all()
    assert env.reset()[keys.POSITION].isfinite().all()


# ---- reward and coverage --------------------------------------------------------------------------------------------------
def loop_weights(config, points):
    """Weights of the fixed families from their formulas."""
    if config.density == "uniform":
        return np.full(len(points), 1 / len(points))
    centres = config.density_center_positions
    phi = [sum(math.exp(-(math.dist(q, c) ** 2) / (2 * config.density_sigma**2)) for c in centres) for q in points]
    return np.array(phi) / sum(phi)


@pytest.mark.parametrize("family", ["uniform", "fixed"])
@pytest.mark.parametrize("d", [2, 3])
def test_reward_is_the_cost_in_units_of_the_docked_uniform_cost(family, d):
    env = make(num_envs=5, dimension=d, dtype="float64", resolution=9, **FAMILIES[family])
    td = wander(env, 6, scale=0.3)
    points = env.density.points.tolist()
    weights = loop_weights(env.config, points)
    docked = np.mean([min(math.dist(s, q) ** 2 for s in env.slots.tolist()) for q in points])
    for b, t in ((0, 0), (3, 5)):
        robots = td["next", keys.POSITION][b, t].tolist()
        cost = sum(w * min(math.dist(p, q) ** 2 for p in robots) for q, w in zip(points, weights, strict=True))
        got = float(td["next", keys.COVERAGE_COST][b, t])
        assert got == pytest.approx(cost + env.density.cell_moment, rel=1e-9)
        reward = td["next", keys.REWARD][b, t].squeeze(-1).tolist()
        # J_ref is under the uniform density for every family: the mean over points plus one cell's own second moment
        moment = sum(((high - low) / 9) ** 2 / 12 for low, high in env.config.bounds)
        assert reward == pytest.approx([-got / (docked + moment)] * 3, rel=1e-9)


def test_reward_of_docked_robots_under_a_uniform_density_is_minus_one():
    env = make(density="uniform")
    td = place(env, env.slots, 0.5, [0, 1, 2])
    out = step(env, current=0.2)
    assert torch.allclose(out[keys.REWARD], torch.tensor(-1.0))
    assert torch.allclose(td[keys.COVERAGE_COST], out[keys.COVERAGE_COST])


# ---- starts ---------------------------------------------------------------------------------------------------------------
STARTS = {
    "one": {"n_agents": 1},
    "three": {},
    "eight": {"n_agents": 8},
    "two_slots_each": {"n_agents": 4, "stations": [[-0.6, 0.1], [0.6, -0.2]], "slots": 2},
    "ring": {"n_agents": 4, "stations": [[0.0, 0.0]], "slots": 4, "slot_radius": 0.13, "charge_radius": 0.36},
    "aerial": {"n_agents": 5, "dimension": 3, "arena": [[-1.0, 1.0], [-1.0, 1.0], [0.0, 1.0]]},
    "logarithmic": {"reserve": "logarithmic", "drain_rate": 0.015},
    "speedy_drain": {"drain_per_speed": 0.02, "drain_per_speed_squared": 0.1},
    "float64": {"dtype": "float64"},
    "no_reassignment": {"reassign_slots": False},
}


def certified(env, td, clearance=0.0):
    slot = env.slots[td[keys.SLOT].squeeze(-1)]
    return is_certified(
        td[keys.POSITION], td[keys.ENERGY].squeeze(-1), slot, env.geometry, env.bounds, clearance=clearance
    )


def docked(env, td):
    return (td[keys.POSITION] == env.slots[td[keys.SLOT].squeeze(-1)]).all(-1).all(-1)


@pytest.mark.parametrize("name", STARTS)
def test_every_start_is_certified(name):
    env = make(num_envs=64, seed=7, **STARTS[name])
    config = env.config
    for _ in range(3):
        td = env.reset()
        assert certified(env, td).all()
        low, high = env.bounds.T
        assert ((td[keys.POSITION] >= low) & (td[keys.POSITION] <= high)).all()
        assert td[keys.ENERGY].max() <= config.energy_max
        slot = td[keys.SLOT].squeeze(-1)
        assert (slot.sort(-1).values.diff(dim=-1) > 0).all()
        assert docked(env, td).double().mean() < 0.75  # not only the last resort
        share = (td[keys.ENERGY] - config.energy_min) / (config.energy_max - config.energy_min)
        assert share.min() >= config.reset_reserve
        assert share.max() - share.min() > 0.3
        assert not any(td[(*keys.VIOLATION, kind)].any() for kind in keys.VIOLATION_KINDS)
        assert not td["done"].any()


def test_starts_keep_the_demanded_clearance_and_reserve():
    env = make(num_envs=64, reset_clearance=0.2, reset_reserve=0.4)
    td = env.reset()
    assert not docked(env, td).all()
    assert certified(env, td, clearance=0.2).all()
    slot = env.slots[td[keys.SLOT].squeeze(-1)]
    way = (td[keys.POSITION] - slot).norm(dim=-1)
    home = 0.06 * (way - env.geometry.reserve_radius).clamp_min(0) / 0.196
    assert (td[keys.ENERGY].squeeze(-1) - 0.1 - home).min() >= 0.4 * 0.9 - 1e-6


def test_docked_is_the_last_resort():
    env = make(num_envs=16, reset_clearance=10.0)  # no drawn pair is ten metres apart
    td = env.reset()
    assert docked(env, td).all()
    assert td[keys.SLOT].squeeze(-1).tolist() == [[0, 1, 2]] * 16
    assert certified(env, td).all()
    assert td[keys.ENERGY].min() >= 0.1 + 0.1 * 0.9
    assert td[keys.ENERGY].max() <= 1.0
    assert td[keys.ENERGY].std() > 0.1


def test_starts_stay_certified_where_rounding_margins_are_wide():
    env = make(num_envs=16, dt=0.001, reset_reserve=0.99)  # many short steps: the energy margin nears a percent
    assert env.geometry.eps_energy > 0.005
    td = env.reset()
    assert certified(env, td).all()
    assert td[keys.ENERGY].max() <= env.config.energy_max


def test_auto_reset_draws_certified_starts_with_fresh_slots():
    env = make(num_envs=8, n_agents=5, horizon=6, seed=4)
    td = wander(env, 40)
    starts = td[td[keys.STEP_COUNT].squeeze(-1) == 0]
    assert len(starts) > 40
    assert certified(env, starts).all()


# ---- slots ----------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["eight", "two_slots_each", "aerial"])
def test_slots_are_unique_at_all_times(name):
    env = make(num_envs=16, on_violation="continue", horizon=25, seed=5, **STARTS[name])
    td = wander(env, 50)
    root, after = td[keys.SLOT].squeeze(-1), td["next", keys.SLOT].squeeze(-1)
    for slot in (root, after):
        assert (slot.sort(-1).values.diff(dim=-1) > 0).all()
        assert slot.min() >= 0
        assert slot.max() < len(env.slots)
    changed = (root != after).any(-1)
    assert changed.any()
    assert certified(env, td["next"])[changed].all()  # a change is adopted only where certified


def test_slots_stay_where_reassignment_is_off():
    env = make(num_envs=16, n_agents=8, reassign_slots=False, on_violation="continue", horizon=0)
    td = wander(env, 40)
    assert torch.equal(td[keys.SLOT], td["next", keys.SLOT])
    assert not torch.equal(td[keys.SLOT][0, 0], td[keys.SLOT][1, 0])  # the reset does choose


def test_crossed_robots_exchange_their_slots_in_a_step():
    env = make(num_envs=1, n_agents=2, stations=[[-0.6, 0.0], [0.6, 0.0]])
    place(env, [[-0.4, 0.3], [0.4, -0.3]], 0.9, [1, 0])
    out = step(env)
    assert out[keys.SLOT].flatten().tolist() == [0, 1]


# ---- checkpoints ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("family", ["drawn", "moving", "age"])
def test_state_dict_continues_the_same_stream_bit_for_bit(family, tmp_path):
    changes = FAMILIES[family] | {"horizon": 7, "n_agents": 4}
    env = make(seed=1, **changes)
    wander(env, 10)
    torch.save(env.state_dict(), tmp_path / "env.pt")

    def go_on(env):
        state = env.state_dict()["state"]
        td = env.set_state(state["position"], state["energy"].unsqueeze(-1))
        return wander(env, 30, seed=8, auto_reset=False, tensordict=td)

    expected = go_on(env)
    assert expected["next", "done"].sum() > 8
    other = make(seed=99, **changes)
    wander(other, 3)
    other.load_state_dict(torch.load(tmp_path / "env.pt", weights_only=True))
    assert_same(go_on(other), expected)


def test_state_dict_is_a_snapshot():
    env = make()
    env.reset()
    saved = env.state_dict()
    before = {name: value.clone() for name, value in saved["state"].items()}
    step(env, torch.full((3, 2), 0.1))
    assert all(torch.equal(saved["state"][name], before[name]) for name in before)
    env.load_state_dict(saved)
    step(env, torch.full((3, 2), 0.1))
    env.reset()
    assert all(torch.equal(saved["state"][name], before[name]) for name in before)


@pytest.mark.parametrize("changes", [{"num_envs": 5}, {"n_agents": 2}, {"density": "age"}, {"dimension": 3}])
def test_state_of_another_world_is_refused(changes):
    saved = make().state_dict()
    with pytest.raises(ValueError, match="shape"):
        make(**changes).load_state_dict(saved)


# ---- set_state and the observation ----------------------------------------------------------------------------------------
def test_set_state_places_every_world_and_keeps_the_rest():
    env = make(num_envs=3)
    wander(env, 5, scale=0.2)
    count = env.state_dict()["state"]["step"]
    position = torch.rand(3, 3, 2, generator=torch.Generator().manual_seed(0))
    energy = torch.tensor([0.3, 0.4, 0.5]).reshape(1, 3, 1).repeat(3, 1, 1)
    slot = torch.tensor([2, 0, 1]).reshape(1, 3, 1).repeat(3, 1, 1)
    td = env.set_state(position, energy, slot)
    assert torch.equal(td[keys.POSITION], position)
    assert torch.equal(td[keys.ENERGY], energy)
    assert torch.equal(td[keys.SLOT], slot)
    assert torch.equal(td[keys.STEP_COUNT], count)
    kept = env.set_state(position + 0.1, energy)
    assert torch.equal(kept[keys.SLOT], slot)
    position += 1  # the environment holds a copy
    assert torch.allclose(step(env)[keys.POSITION], position - 0.9)


@pytest.mark.parametrize("horizon", [20, 0])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_observation_field_by_field(family, d, horizon):
    arena = [[-1.0, 2.0], [0.0, 2.0], [0.0, 1.0]][:d]
    env = make(
        num_envs=2, n_agents=4, dimension=d, arena=arena, horizon=horizon, dtype="float64", resolution=8,
        energy_min=0.2, energy_max=1.2, observe_centroid=True, density_amplitude=0.2, density_period=10.0,
        on_violation="continue", seed=6, **FAMILIES[family],
    )  # fmt: skip
    td = wander(env, 3, scale=0.3)[:, -1]["next"]
    length, middle = 1.5, np.array([(low + high) / 2 for low, high in arena])
    b = 1
    position, energy = td[keys.POSITION][b].numpy(), td[keys.ENERGY][b, :, 0].numpy()
    share = (energy - 0.2) / 1.0
    stations, slots = np.array(env.config.station_positions), np.array(env.config.slot_positions)
    points = env.density.points.numpy()
    params = td[keys.DENSITY][b].numpy() if env.density.n_params else None
    weights = env.density.weights(torch.zeros(1, 0) if params is None else td[keys.DENSITY][b : b + 1])
    weights = weights.reshape(-1).numpy()
    owner = np.array([min(range(4), key=lambda i, q=q: math.dist(position[i], q)) for q in points])
    for i in range(4):
        others = [(i + 1) % 4, (i + 2) % 4, (i + 3) % 4]
        expected = [*(position[i] - middle) / length, share[i]]
        expected += [*(slots[int(td[keys.SLOT][b, i])] - position[i]) / length]
        for s in stations:
            expected += [*(s - position[i]) / length]
        for j in others:
            expected += [*(position[j] - position[i]) / length]
        expected += [share[j] for j in others]
        if family == "drawn":
            expected += [*((params.reshape(3, d) - middle) / length).flatten()]
        if family == "moving":
            for angle, centre in zip(params, env.config.density_center_positions, strict=True):
                place = [centre[0] + 0.2 * math.cos(angle), centre[1] + 0.2 * math.sin(angle), *centre[2:]]
                expected += [*(np.array(place) - middle) / length]
        if family == "age":
            expected += [*env.density.observe(td[keys.DENSITY][b : b + 1])[0].numpy()]  # values: test_density
        if horizon:
            expected += [3 / 20]
        mine = owner == i
        centroid = (weights[mine, None] * points[mine]).sum(0) / weights[mine].sum()
        expected += [*(centroid - position[i]) / length]
        np.testing.assert_allclose(td[keys.OBSERVATION][b, i].numpy(), expected, atol=1e-12)
        assert env.n_observation == len(expected)


def test_time_in_the_observation_never_passes_one():
    env = make(n_agents=1, horizon=2, on_violation="continue")
    place(env, env.slots, 0.5)
    assert [float(step(env, current=0.2)[keys.OBSERVATION][0, 0, -1]) for _ in range(4)] == [0.5, 1.0, 1.0, 1.0]


def test_density_moves_with_the_steps_and_starts_anew():
    env = make(num_envs=3, density="moving", density_period=8.0)
    first = env.reset()[keys.DENSITY]
    phases = [step(env)[keys.DENSITY] for _ in range(5)]
    turned = (phases[-1] - first) % (2 * math.pi)
    assert torch.allclose(turned, torch.tensor(2 * math.pi * 5 * 0.2 / 8.0), atol=1e-5)
    assert not torch.equal(env.reset()[keys.DENSITY], first)


def test_points_near_a_robot_are_young():
    env = make(num_envs=1, n_agents=2, density="age", on_violation="continue", sensing_radius=0.3, resolution=12)
    env.reset()
    place(env, [[0.0, 0.0], [0.6, 0.6]], 0.9, [0, 1])
    for _ in range(3):
        out = step(env)
    ages = out[keys.DENSITY][0].tolist()
    for q, age in zip(env.density.points.tolist(), ages, strict=True):
        seen = min(math.dist(q, (0.0, 0.0)), math.dist(q, (0.6, 0.6))) <= 0.3
        assert age == pytest.approx(0.0 if seen else 0.6, abs=1e-6)


# ---- device ---------------------------------------------------------------------------------------------------------------
@pytest.mark.gpu
def test_worlds_step_on_the_graphics_card():
    config = SurveillanceConfig(n_agents=5, density="moving")
    env = SurveillanceEnv(config, num_envs=32, device="cuda", seed=0)
    check_env_specs(env, seed=0)
    td = env.rollout(20, break_when_any_done=False)
    assert all(td[name].device.type == "cuda" for name in td.keys(True, True))
    assert certified(env, env.reset()).all()
    env.load_state_dict(env.state_dict())
    # the same states and actions give the same transition as on the processor
    host = SurveillanceEnv(config, num_envs=32, seed=0)
    start = env.reset()
    action = 0.1 * torch.randn(32, 5, 2, generator=torch.Generator().manual_seed(0))
    outs = []
    for e in (env, host):
        e.set_state(*(start[name].to(e.device) for name in (keys.POSITION, keys.ENERGY, keys.SLOT)))
        outs.append(e.step(TensorDict({keys.ACTION: action.to(e.device)}, [32], device=e.device))["next"])
    for name in (keys.POSITION, keys.ENERGY):
        assert torch.allclose(outs[0][name].cpu(), outs[1][name], atol=1e-5)
    assert torch.equal(outs[0][keys.SLOT].cpu(), outs[1][keys.SLOT])
