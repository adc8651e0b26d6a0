"""Invariance in worlds that hypothesis chooses: layout, size, family, type, gains, start states and adversary."""

import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from envs import SurveillanceConfig, SurveillanceEnv
from envs.homing import certified_parts, closest_approach, homing_velocity
from envs.transition import transition
from safety import SafetyConfig, SafetyFilter
from tests.worlds import KINDS, accepted, draw_fields, edge_states, raw_margins, roll_out

torch.set_num_threads(1)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
@given(
    world_seed=st.integers(0, 10**6), seed=st.integers(0, 2**31 - 1), kinds=st.sets(st.sampled_from(KINDS), min_size=1)
)
def test_no_promise_is_broken_in_any_world(world_seed, seed, kinds):
    fields, gains = draw_fields(world_seed)
    try:
        world = SurveillanceConfig(**fields)
        SafetyFilter(SafetyConfig(**gains), world)
    except ValueError:
        assume(False)
    record = roll_out(world, gains, worlds=4, steps=8, seed=seed, kinds=tuple(sorted(kinds)))
    d, g = record.data, record.env.geometry
    assert not d["outside"].any()
    for kind in ("depleted", "stranded", "overcharged", "collision"):
        assert not d[kind].any()
    assert all((margin >= 0).all() for margin in raw_margins(record))
    slots = record.env.slots[d["next_slot"]]
    robots, pairs = certified_parts(d["next_position"], d["next_energy"], slots, g, record.env.bounds, margins=0)
    assert robots.all()
    assert pairs.all()
    assert (d["next_slot"].sort(-1).values.diff(dim=-1) > 0).all()
    ulp = torch.finfo(world.torch_dtype).eps  # norms summed in another order
    assert d["action"].norm(dim=-1).max() <= world.max_speed * (1 + ulp)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(world_seed=st.integers(0, 10**6), seed=st.integers(0, 2**31 - 1))
def test_a_joint_homing_step_lowers_no_certificate(world_seed, seed):
    fields, gains = draw_fields(world_seed)
    try:
        world = SurveillanceConfig(**fields | {"dtype": "float64"})
        alphas = SafetyConfig(**gains).gains(world)
    except ValueError:
        assume(False)
    env = SurveillanceEnv(world, 8, seed=seed % 1000)
    position, energy, slot = edge_states(env, seed)
    home = env.slots[slot]
    current, _ = accepted(world, position, energy, env.stations, alphas.overcharge)
    velocity = homing_velocity(position, home, world.homing)
    after, next_energy = transition(position, energy, velocity, current, env.stations, world)
    before = closest_approach(position, home, world.homing)
    if before.numel():
        assert (closest_approach(after, home, world.homing) - before).min() >= -1e-12
    robots, pairs = certified_parts(after, next_energy, home, world.homing, env.bounds, margins=1)
    assert robots.all()
    assert pairs.all()
