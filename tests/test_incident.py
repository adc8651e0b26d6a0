"""Dumps of violations: nothing where there is none, the exact step where there is one, and a test for every dump kept."""

import functools
import json
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictSequential

from agents import make_controller
from agents.evaluation import evaluate_policy
from agents.incident import ViolationError, check_violations, load_incident, replay, save_incident
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)
KEPT = sorted((Path(__file__).parent / "violations").glob("*.json"))


def violating_step(**fields):
    """One transition of 8 worlds, two robots of world 3 about to collide and one of world 5 empty, unfiltered."""
    world, safety = SurveillanceConfig(**fields), SafetyConfig(mode="none")
    env = SurveillanceEnv(world, 8, seed=0)
    td = env.reset()
    position, energy = td[keys.POSITION].clone(), td[keys.ENERGY].clone()
    position[3, 1] = position[3, 0] + 0.13 * (position[3, 0] < 0).to(position.dtype) - 0.065
    energy[5, 2] = world.energy_min
    td = env.set_state(position, energy)
    td[keys.NOMINAL_ACTION] = torch.full_like(position, 0.05)
    return world, safety, env.step(SafetyFilter(safety, world)(td))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_dump_replays_to_the_same_bits(tmp_path, dtype):
    world, safety, td = violating_step(dtype=dtype)
    path = save_incident(tmp_path / "folder" / "x.json", td[5], world, safety)
    incident = load_incident(path)
    assert (incident.world, incident.safety) == (world, safety)
    assert "depleted" in incident.kinds
    again = replay(incident)
    for key in (keys.POSITION, keys.ENERGY):
        assert torch.equal(again[key][0], td[key][5])
        assert torch.equal(again["next"][key][0], td["next"][key][5])
    for kind in keys.VIOLATION_KINDS:
        assert again["next"][(*keys.VIOLATION, kind)].any() == (kind in incident.kinds)


def test_dump_keeps_nan_and_infinite_actions(tmp_path):
    world, safety, td = violating_step()
    td[keys.NOMINAL_ACTION][5, 0] = torch.tensor([torch.nan, -torch.inf])
    incident = load_incident(save_incident(tmp_path / "x.json", td[5], world, safety))
    torch.testing.assert_close(incident.state[keys.NOMINAL_ACTION][0], td[keys.NOMINAL_ACTION][5], equal_nan=True)


@pytest.mark.parametrize("shape", [(8,), (8, 1), (2, 4)])
def test_first_violation_behind_the_certified_filter_stops_with_a_dump(tmp_path, shape):
    world, _, td = violating_step()
    with pytest.raises(ViolationError, match=r"behind the certified filter.*violation\.json") as error:
        check_violations(td.reshape(shape), world=world, safety=SafetyConfig(), folder=tmp_path)
    content = json.loads((tmp_path / "violation.json").read_text())
    first = next(b for b in range(8) if any(td["next"][(*keys.VIOLATION, k)][b].any() for k in keys.VIOLATION_KINDS))
    assert content["state"]["position"] == td[keys.POSITION][first].tolist()
    assert content["next"]["energy"] == td["next"][keys.ENERGY][first].tolist()
    assert all(kind in str(error.value) for kind in content["kinds"])


def test_ended_worlds_and_other_filters_do_not_stop(tmp_path):
    world, safety, td = violating_step()
    check_violations(td, world=world, safety=safety, folder=tmp_path)
    check_violations(td, torch.zeros(8, 1, dtype=torch.bool), world=world, safety=SafetyConfig(), folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_evaluation_stops_at_a_broken_promise(tmp_path):
    """A filter that is certified in name only: the nominal action passes."""
    world, safety = SurveillanceConfig(), SafetyConfig()
    broken = SafetyFilter(safety, world)
    broken.safety = SafetyConfig(mode="none")
    broken.out_keys = SafetyFilter(broken.safety, world).out_keys
    policy = TensorDictSequential(make_controller("flee", world), broken)
    check = functools.partial(check_violations, world=world, safety=safety, folder=tmp_path)
    with pytest.raises(ViolationError, match="behind the certified filter"):
        evaluate_policy(SurveillanceEnv(world, 16, seed=0), policy, 100, check=check)
    again = replay(load_incident(tmp_path / "violation.json"))  # with the filter as it should be
    assert again[keys.ACTION].isfinite().all()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"env": {"nonsense": 1}, "safety": {}}'])
def test_something_else_is_refused(tmp_path, text):
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"x\.json is not the dump of a violation"):
        load_incident(path)


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_states_that_once_broke_the_filter_no_longer_do(path):
    td = replay(load_incident(path))
    assert not any(td["next"][(*keys.VIOLATION, kind)].any() for kind in keys.VIOLATION_KINDS)
