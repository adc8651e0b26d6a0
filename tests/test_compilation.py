"""compile=true: the same results to rounding, the same promise, and no reason to fail."""

import copy
import pickle
from types import SimpleNamespace

import pytest
import torch
from tensordict.nn import TensorDictSequential

import envs.compilation
from agents import make_controller
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.compilation import Compiled, compiled
from safety import SafetyConfig, SafetyFilter

pytestmark = pytest.mark.xdist_group("compilation")  # the compiler starts once


def roll_out(world, steps=15, compile=False):
    env = SurveillanceEnv(world, 24, seed=3, compile_functions=compile)
    assert isinstance(env._transition, Compiled) == isinstance(env._violations, Compiled) == compile
    assert "_compiled_step_and_maybe_reset" not in vars(env)  # TorchRL's own way: TensorDicts through Dynamo
    policy = TensorDictSequential(
        make_controller("gather", world), SafetyFilter(SafetyConfig(), world, compile=compile)
    )
    return env.rollout(steps, policy, break_when_any_done=False)


@pytest.fixture
def world():
    return SurveillanceConfig(dtype="float64", resolution=3)


def test_compiled_roll_out_is_the_same_to_rounding(world):
    plain, fast = roll_out(world), roll_out(world, compile=True)
    for key in (keys.POSITION, keys.ENERGY, keys.ACTION, keys.CHARGE_CURRENT, keys.REWARD):
        where = ("next", *key) if key == keys.REWARD else key
        torch.testing.assert_close(fast[where], plain[where], rtol=0, atol=1e-9)
    for kind in keys.VIOLATION_KINDS:
        assert not fast[("next", *keys.VIOLATION, kind)].any()
    assert not fast[keys.OUTSIDE].any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_whole_filter_of_fixed_sizes_is_one_graph(dimension):
    """Traced without a break; the code for it takes a compiler a minute, which is left to benchmarks and GPU tests."""
    world = SurveillanceConfig(dtype="float64", resolution=3, dimension=dimension)
    env, f = SurveillanceEnv(world, 24, seed=3), SafetyFilter(SafetyConfig(), world, fixed_sizes=True)
    td = make_controller("gather", world)(env.reset())
    inputs = (td[keys.NOMINAL_ACTION], td[keys.POSITION], td[keys.ENERGY].squeeze(-1), td[keys.SLOT].squeeze(-1))
    with torch.no_grad():
        traced = torch.compile(f.filter, backend="eager", fullgraph=True, dynamic=False)(*inputs)
        for one, other in zip(traced, f.filter(*inputs), strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def test_fixed_sizes_compile_the_filter_and_not_its_parts(world):
    made = {fixed: SafetyFilter(SafetyConfig(), world, compile=True, fixed_sizes=fixed) for fixed in (False, True)}
    for fixed, f in made.items():
        again = copy.deepcopy(f)
        assert (isinstance(again._filter, Compiled), isinstance(again._transition, Compiled)) == (fixed, not fixed)
        assert not fixed or again._filter.dynamic is False
        assert not fixed or again._filter.function.__self__ is again


def test_violations_are_counted_when_compiled(world):
    env = SurveillanceEnv(world, 24, compile_functions=True)
    td, seen = env.reset(), 0
    for _ in range(40):  # everybody to one point, unfiltered
        td[keys.ACTION] = -0.2 * torch.nn.functional.normalize(td[keys.POSITION], dim=-1)
        td = env.step(td)["next"]
        seen += td[(*keys.VIOLATION, "collision")].sum()
    assert seen > 0


def test_without_a_compiler_a_warning_and_the_same_results(world, monkeypatch):
    plain = roll_out(world)
    monkeypatch.setattr(envs.compilation.Compiled, "warned", False)

    def broken(function, **_):
        def call(*_):
            raise RuntimeError("no working C++ compiler\nmore lines")

        return call

    monkeypatch.setattr(envs.compilation, "torch", SimpleNamespace(compile=broken))
    with pytest.warns(UserWarning, match="compile=true has no effect.*no working C") as seen:
        without = roll_out(world, compile=True)
    assert len([warning for warning in seen if "compile=true" in str(warning.message)]) == 1
    assert torch.equal(without[keys.POSITION], plain[keys.POSITION])


def test_a_compiled_function_survives_a_copy():
    function = pickle.loads(pickle.dumps(compiled(torch.sin, enabled=True)))
    torch.testing.assert_close(copy.deepcopy(function)(torch.ones(3)), torch.ones(3).sin())


def test_torchrls_own_compilation_is_refused(world):
    with pytest.raises(TypeError, match="compile_functions=True"):
        SurveillanceEnv(world, 2, compile=True)


def test_off_means_untouched():
    function = torch.sin
    assert compiled(function, enabled=False) is function
