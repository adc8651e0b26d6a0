"""The patrol: way-points are reached and counted, and alone it never runs empty."""

import pytest
import torch
from torchrl.envs.utils import step_mdp

from agents import make_controller
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)


def make_world(**fields):
    return SurveillanceConfig(horizon=0, on_violation="continue", dtype="float64", **fields)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch_shape_and_the_same_way_points_by_the_same_seed(batch):
    world = make_world(n_agents=3)
    td = SurveillanceEnv(world, 6).reset().select(keys.POSITION, keys.ENERGY, keys.SLOT)
    td = td.reshape(2, 3) if batch else td[0]
    td[keys.ENERGY] = torch.full_like(td[keys.ENERGY], 0.99)
    first, again, other = (
        make_controller("patrol", world, seed)(td.clone())[keys.NOMINAL_ACTION] for seed in (3, 3, 4)
    )
    assert first.shape == (*batch, 3, 2)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("d", [2, 3])
def test_patrol_alone_reaches_way_points_and_never_runs_empty(d):
    world = make_world(n_agents=1, dimension=d)
    env, controller = SurveillanceEnv(world, 16, seed=1), make_controller("patrol", world)
    td, energies = env.reset(), []
    assert controller.metrics() == {"waypoints": 0.0}
    off = SafetyFilter(SafetyConfig(mode="none"), world)
    for _ in range(200):
        td = env.step(off(controller(td)))
        for kind in ("depleted", "stranded"):
            assert not td["next", *keys.VIOLATION, kind].any()
        td = step_mdp(td)
        energies.append(td[keys.ENERGY])
    assert controller.metrics()["waypoints"] > 16
    energies = torch.stack(energies)
    assert energies.amax(0).min() > 0.9  # charged
    assert energies.amin(0).max() < 0.7  # and used


def test_patrol_counts_a_way_point_once_it_is_near():
    world = make_world(n_agents=1)
    controller, td = make_controller("patrol", world), SurveillanceEnv(world, 1).reset()
    td[keys.ENERGY] = torch.full_like(td[keys.ENERGY], 0.99)
    td[keys.POSITION] = torch.zeros(1, 1, 2, dtype=torch.float64)
    action = controller(td)[keys.NOMINAL_ACTION]
    target = controller._memory["waypoint"]
    torch.testing.assert_close(action, world.max_speed * target / target.norm())
    for share, count in ((1.1, 0.0), (0.9, 1.0)):
        td[keys.POSITION] = target - share * controller.arrival * target / target.norm()
        controller(td)[keys.NOMINAL_ACTION]
        assert controller.metrics() == {"waypoints": count}
    assert not torch.equal(controller._memory["waypoint"], target)
    td[keys.ENERGY] = torch.full_like(td[keys.ENERGY], world.energy_min + 0.05)
    way = torch.tensor(world.slot_positions, dtype=torch.float64)[td[keys.SLOT].squeeze(-1)] - td[keys.POSITION]
    torch.testing.assert_close(controller(td)[keys.NOMINAL_ACTION], world.homing.speed * way / way.norm())
