"""The learned safety layer: its closed form, its fit, and what it does behind the filter's interface."""

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from agents import AgentConfig, make_controller
from agents.evaluation import evaluate_policy
from agents.maddpg import make_loss
from agents.networks import make_actor, make_critic
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import QPStatus, SafetyConfig, SafetyFilter, dalal, solve_qp

torch.set_num_threads(1)
F64 = torch.float64
BRIEF = {"mode": "dalal", "dalal_steps": 40}  # a rough fit is enough where only the layer's form is looked at
WORLD = SurveillanceConfig()
CONTINUE = SurveillanceConfig(on_violation="continue")


def uniform(*shape, seed, dtype=torch.float32):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def random_inputs(world, batch, seed=0):
    """Nominal action, position, energy, slot: start states with random energies, actions up to twice the limit."""
    start = SurveillanceEnv(world, batch, seed=seed).reset()
    position, slot = start[keys.POSITION], start[keys.SLOT].squeeze(-1)
    span = 1.2 * (world.energy_max - world.energy_min)
    energy = world.energy_min + span * (uniform(*slot.shape, seed=seed + 1).to(position) - 0.1)
    nominal = 2 * world.max_speed * (2 * uniform(*position.shape, seed=seed + 2).to(position) - 1)
    return nominal, position, energy, slot


def run(f, inputs):
    """Outputs by short name."""
    return dict(zip((key[-1] for key in f.out_keys), f.filter(*inputs), strict=True))


def layer_of(f):
    assert f.layer is not None
    return f.layer


def linear_model(f, inputs):
    """Gains and values of the constraints, as the filter takes them."""
    _, position, energy, slot = inputs
    return layer_of(f).linear_model(position, energy, slot, *f._barriers(position, energy, slot))


def cut(nominal, world):
    return nominal * (world.max_speed / nominal.norm(dim=-1, keepdim=True)).clamp(max=1)


# ---- closed form -----------------------------------------------------------------------------------------------------
def test_closed_form_by_hand():
    action = torch.tensor([1.0, 0.0], dtype=F64)
    gain = torch.tensor([[2.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=F64)
    # multipliers (2 - 1) / 4, (0 + 0.3) / 1 and (1 - 0.5) / 2 = 0.25: the second is the largest
    value = torch.tensor([-1.0, 0.3, -0.5], dtype=F64)
    torch.testing.assert_close(dalal.closed_form(action, gain, value), torch.tensor([0.0, 0.3], dtype=F64))
    none = dalal.closed_form(action, gain, torch.tensor([-2.5, -0.1, -1.5], dtype=F64))
    assert torch.equal(none, torch.zeros(2, dtype=F64))


@pytest.mark.parametrize("d", [2, 3])
def test_closed_form_of_one_constraint_is_the_quadratic_programs(d):
    gain, value = 2 * uniform(200, 1, d, seed=0, dtype=F64) - 1, uniform(200, 1, seed=1, dtype=F64) - 0.5
    action = 2 * uniform(200, d, seed=2, dtype=F64) - 1
    kept = gain.square().sum((-2, -1)) > dalal.GAIN_FLOOR
    got = action - dalal.closed_form(action, gain, value)
    solution = solve_qp(torch.eye(d, dtype=F64), -action, gain, -value, solver="exact")
    assert ((got - action).norm(dim=-1) > 1e-3)[kept].sum() > 20
    torch.testing.assert_close(got[kept], solution.value[kept], rtol=0, atol=1e-9)


def test_constraint_without_gain_gives_no_huge_correction():
    action, value = torch.tensor([0.5, 0.5]), torch.tensor([1.0])
    for size in (0.0, 1e-6, 1e-2):
        correction = dalal.closed_form(action, torch.full((1, 2), size), value)
        assert correction.norm() <= 2 * size / dalal.GAIN_FLOOR


@pytest.mark.parametrize("seed", [0, 1])
def test_correction_satisfies_the_most_violated_model(seed):
    world = SurveillanceConfig(dtype="float64")
    f = SafetyFilter(SafetyConfig(**BRIEF), world)
    inputs = random_inputs(world, 100, seed)
    gain, value = linear_model(f, inputs)
    nominal = torch.cat([cut(inputs[0], world) / world.max_speed, torch.ones_like(inputs[2]).unsqueeze(-1)], -1)
    size = gain.square().sum(-1)
    multiplier = ((gain * nominal.unsqueeze(-2)).sum(-1) + value) / size.clamp_min(dalal.GAIN_FLOOR)
    worst = multiplier.argmax(-1, keepdim=True)
    corrected = nominal - dalal.closed_form(nominal, gain, value)
    excess = (gain * corrected.unsqueeze(-2)).sum(-1) + value
    served = ((multiplier > 0).any(-1) & (size.gather(-1, worst).squeeze(-1) > dalal.GAIN_FLOOR)).nonzero().unbind(-1)
    assert len(served[0]) > 50
    torch.testing.assert_close(excess.gather(-1, worst).squeeze(-1)[served], torch.zeros(len(served[0]), dtype=F64))
    # and the filter executes it, cut to the ball and to the currents that there are
    out = run(f, inputs)
    executed = cut(world.max_speed * corrected[..., :-1], world)
    torch.testing.assert_close(out["action"], executed, rtol=0, atol=1e-6)
    torch.testing.assert_close(out["charge_current"].squeeze(-1), corrected[..., -1].clamp(0, 1), rtol=0, atol=1e-6)


# ---- behind the filter's interface -----------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_unviolated_models_pass_the_action_bit_for_bit(dtype):
    world = SurveillanceConfig(dtype=dtype)
    f = SafetyFilter(SafetyConfig(**BRIEF), world)
    nominal, *state = random_inputs(world, 200)
    nominal = 0.4 * nominal / 2
    gain, value = linear_model(f, (nominal, *state))
    action = torch.cat([nominal / world.max_speed, torch.ones_like(state[1]).unsqueeze(-1)], -1)
    free = ((gain * action.unsqueeze(-2)).sum(-1) + value < 0).all(-1)
    out = run(f, (nominal, *state))
    assert free.sum() > 50
    assert (~free).sum() > 50
    assert torch.equal(out["action"][free], nominal[free])
    assert (out["charge_current"].squeeze(-1)[free] == 1).all()
    assert (out["correction"].squeeze(-1)[free] == 0).all()
    assert (out["correction"].squeeze(-1)[~free] > 0).any()


@pytest.mark.parametrize(("n", "d"), [(1, 2), (3, 2), (5, 2), (1, 3), (3, 3)])
def test_outputs_of_every_world_are_those_of_the_other_filters(n, d):
    world = SurveillanceConfig(n_agents=n, dimension=d)
    f, paper = SafetyFilter(SafetyConfig(**BRIEF), world), SafetyFilter(SafetyConfig(mode="paper"), world)
    inputs = random_inputs(world, 60)
    out, other = run(f, inputs), run(paper, inputs)
    assert list(out) == list(other)
    for name, value in out.items():
        assert (value.shape, value.dtype) == (other[name].shape, other[name].dtype), name
        assert (value.isfinite() | (value == other[name])).all(), name  # h_s of a single robot is inf
    for name in ("h_c", "h_o", "h_s", "outside"):
        assert torch.equal(out[name], other[name]), name
    assert out["action"].norm(dim=-1).max() <= world.max_speed
    assert ((out["charge_current"] >= 0) & (out["charge_current"] <= 1)).all()
    assert (out["charge_current"] < 1).any()
    assert (out["status"] == QPStatus.SOLVED).all()
    assert (out["level"] == 0).all()
    assert (out["residual"] == 0).all()
    assert set(layer_of(f).model.r_squared) == {"energy", "overcharge", "collision"} - (
        {"collision"} if n == 1 else set()
    )
    shaped = run(f, tuple(x.unflatten(0, (6, 10)) for x in inputs))
    torch.testing.assert_close(shaped["action"].flatten(0, 1), out["action"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_robot_with_non_finite_nominal_holds(bad):
    f = SafetyFilter(SafetyConfig(**BRIEF), WORLD)
    nominal, *state = random_inputs(WORLD, 20)
    broken = nominal.clone()
    broken[:, 1, 0] = bad
    broken.requires_grad_()
    whole, out = run(f, (nominal, *state)), run(f, (broken, *state))
    assert (out["action"][:, 1] == 0).all()
    assert (out["status"][:, 1] == QPStatus.INACCURATE).all()
    assert (out["level"][:, 1] == 1).all()
    assert (out["correction"][:, 1] == WORLD.max_speed).all()
    assert torch.equal(out["action"][:, [0, 2]], whole["action"][:, [0, 2]])
    assert all(value.isfinite().all() for value in out.values())
    (gradient,) = torch.autograd.grad(out["action"].square().sum() + out["correction"].square().sum(), broken)
    assert gradient.isfinite().all()
    assert (gradient[:, 1] == 0).all()


def test_filter_is_a_pure_function_and_knows_its_keys():
    f = SafetyFilter(SafetyConfig(**BRIEF), WORLD)
    nominal, position, energy, slot = random_inputs(WORLD, 10)
    content = {keys.NOMINAL_ACTION: nominal, keys.POSITION: position}
    content |= {keys.ENERGY: energy[..., None], keys.SLOT: slot[..., None]}
    td = TensorDict(content, [10])
    first = f(td.clone())
    f(TensorDict({key: value[:3].flip(0) for key, value in content.items()}, [3]))
    again = f(td.clone())
    assert all(torch.equal(first[key], again[key]) for key in f.out_keys)
    assert all(torch.equal(td[key], value) for key, value in content.items())
    with pytest.raises(KeyError, match="energy"):
        f(td.exclude(keys.ENERGY))
    for twin in (copy.deepcopy(f), pickle.loads(pickle.dumps(f))):
        assert all(torch.equal(first[key], value) for key, value in twin(td.clone()).items(True, True) if key in first)
    assert list(f.state_dict()) == list(f.parameters()) == list(f.buffers()) == []


# ---- the fit ---------------------------------------------------------------------------------------------------------
def test_fit_is_the_same_again_and_leaves_the_global_stream_alone():
    torch.manual_seed(5)
    before = torch.get_rng_state()
    first = dalal.fit(WORLD, 40)
    assert dalal.fit(SurveillanceConfig(), 40) is first
    dalal._fit.cache_clear()
    with torch.inference_mode():
        second = dalal.fit(WORLD, 40)
    assert second is not first
    assert all(torch.equal(a, b) for a, b in zip(first.weights, second.weights, strict=True))
    assert first.r_squared == second.r_squared
    assert torch.equal(torch.get_rng_state(), before)
    assert not any(weight.requires_grad for weight in first.weights)


def test_models_explain_what_an_action_changes():
    model = dalal.fit(CONTINUE, SafetyConfig().dalal_steps)
    assert model.r_squared["energy"] > 0.95
    assert model.r_squared["overcharge"] > 0.92
    # half of a pair's change is the other robot's random motion: 0.5 is all that there is to explain
    assert model.r_squared["collision"] > 0.48


def test_gains_are_the_worlds():
    world = CONTINUE
    f = SafetyFilter(SafetyConfig(mode="dalal"), world)
    # robot 0 on its way, robot 1 a safety distance and a half away, robot 2 in its slot
    slots = torch.tensor(world.slot_positions)
    position = torch.stack([0.3 * slots[0], 0.3 * slots[0], slots[2]])
    position[1, 1] += 1.5 * world.safety_distance
    gain, _ = linear_model(f, (None, position, torch.tensor([0.5, 0.5, 0.6]), torch.arange(3)))
    outward = -slots[0] / slots[0].norm()
    torch.testing.assert_close(gain[0, 0, :2], outward, rtol=0, atol=0.15)  # a step away costs a step's energy
    assert gain[0, 0, 2].abs() < 0.5  # no charge out here; in the slot a step's charge is six steps' drain
    assert gain[2, 0, 2] == pytest.approx(-world.charge_rate / world.drain_rate, rel=0.2)
    assert gain[2, 1, 2] == pytest.approx(1.0, abs=0.2)
    # robot 1 is the first of robot 0's others: towards it
    assert torch.cosine_similarity(gain[0, 2, :2], torch.tensor([0.0, 1.0]), dim=0) > 0.85
    assert gain[0, 2, :2].norm() == pytest.approx(1.5, rel=0.4)


def test_without_the_drift_the_fit_is_worse():
    with_drift, literal = (dalal.fit(WORLD, 300, drift=drift).r_squared for drift in (True, False))
    assert with_drift["energy"] > literal["energy"] + 0.1
    f = SafetyFilter(SafetyConfig(mode="dalal", dalal_steps=300, dalal_drift=False, dalal_margin=0.0), WORLD)
    inputs = random_inputs(WORLD, 10)
    _, value = linear_model(f, inputs)
    h_c = run(f, inputs)["h_c"].squeeze(-1)
    torch.testing.assert_close(value[..., 0], -h_c / (WORLD.dt * WORLD.drain_rate))  # c(s) alone


# ---- in the loss -----------------------------------------------------------------------------------------------------
def test_gradient_through_the_layer_is_the_finite_differences():
    world = SurveillanceConfig(dtype="float64")
    f = SafetyFilter(SafetyConfig(**BRIEF), world)
    nominal, *state = random_inputs(world, 40)
    nominal, weight = 0.7 * nominal, uniform(*nominal.shape, seed=9, dtype=F64)

    def score(x):
        action, current, *_ = f.filter(x, *state)
        return (weight * action).sum((-2, -1)) + current.sum((-2, -1))

    x = nominal.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(score(x).sum(), x)
    step = 1e-7
    for i, k in ((0, 0), (1, 1), (2, 0)):
        moved = torch.zeros_like(nominal)
        moved[:, i, k] = step
        numeric = (score(nominal + moved) - score(nominal - moved)) / (2 * step)
        # a world whose constraint or cut changes within the step may differ
        assert ((gradient[:, i, k] - numeric).abs() < 1e-5).float().mean() > 0.95
    corrected = run(f, (nominal, *state))["correction"].squeeze(-1) > 1e-3
    assert corrected.any()
    assert (gradient[corrected].norm(dim=-1) > 0).any()


def test_loss_takes_no_weight_of_the_layer_for_a_parameter():
    agent = AgentConfig(actor_cells=[8], critic_cells=[8])
    env = SurveillanceEnv(WORLD, 2, seed=0)
    actor, critic = make_actor(env.n_observation, WORLD, agent), make_critic(env.n_observation, WORLD, agent)
    names = []
    for safety in ({"mode": "none"}, BRIEF):
        loss, _ = make_loss(actor, critic, agent, SafetyConfig(**safety, in_loss=True), WORLD)
        names.append({name: tuple(p.shape) for name, p in loss.named_parameters()} | dict.fromkeys(loss.state_dict()))
    assert names[0] == names[1]
    td = env.rollout(4, TensorDictSequential(actor, SafetyFilter(SafetyConfig(**BRIEF), WORLD)))
    loss(td.reshape(-1))["loss_actor"].sum().backward()
    gradients = [p.grad for p in loss.actor_network_params.values(True, True)]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    assert any(gradient.abs().max() > 0 for gradient in gradients)


# ---- configurations --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"dalal_margin": -0.1}, r"safety\.dalal_margin=-0\.1 is out of range: allowed \[0, 100\]"),
        ({"dalal_margin": math.nan}, r"safety\.dalal_margin=nan"),
        ({"dalal_steps": 0}, r"safety\.dalal_steps=0 is out of range: allowed \[1, 1000000\]"),
    ],
)
def test_configuration_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        SafetyConfig(mode="dalal", **fields)


# ---- in the world ----------------------------------------------------------------------------------------------------
def measure(controller, **safety):
    policy = TensorDictSequential(
        make_controller(controller, CONTINUE, seed=2), SafetyFilter(SafetyConfig(**safety), CONTINUE)
    )
    metrics, statistics, _ = evaluate_policy(SurveillanceEnv(CONTINUE, 32, seed=1), policy, 100)
    return metrics["violations"], metrics, statistics


def test_layer_keeps_most_random_robots_alive():
    unfiltered, *_ = measure("random", mode="none")
    layered, metrics, statistics = measure("random", mode="dalal")
    assert all(unfiltered[kind] > 50 for kind in unfiltered)
    assert sum(layered.values()) < 0.01 * sum(unfiltered.values())
    assert 0.1 < statistics["intervention_rate"] < 0.6
    assert statistics["fallback_rate"] == 0
    assert metrics["charges_per_robot"] > 0.5


def test_bare_limit_violates_and_is_counted():
    bare, _, statistics = measure("random", mode="dalal", dalal_margin=0.0)
    assert bare["stranded"] > 100
    assert statistics["outside"] > 100
