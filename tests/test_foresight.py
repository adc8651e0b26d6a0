"""What the critics are told of the actions' consequences, against loops written out here and against the world itself."""

import pytest
import torch

from agents import AgentConfig
from agents.foresight import POINTS_PER_AXIS, Foresight, cost_of_own
from agents.maddpg import make_loss
from agents.networks import Critic, joint_action, make_actor, make_critic, make_policies
from agents.pipeline import to_transitions
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig

torch.set_num_threads(1)
STEPS = 5
WORLDS = pytest.mark.parametrize(
    "fields",
    [
        {},
        {"n_agents": 1},
        {"n_agents": 2},
        {"n_agents": 5, "density": "uniform"},
        {"density_per_world": True, "arena": [[0.5, 2.5], [1, 3]]},
        {"density": "moving"},
        {"density": "age", "horizon": 0},
        {"dimension": 3, "arena": [[-1, 1], [-1, 1], [0, 1]], "density": "uniform"},
        {"observe_centroid": True, "density_per_world": True},
    ],
    ids=lambda fields: "-".join(map(str, fields)) or "default",
)


def start(batch=6, seed=0, **fields):
    """World, observations of start states (one robot almost full in its charger) and random actions, float64."""
    config = SurveillanceConfig(dtype="float64", **fields)
    env = SurveillanceEnv(config, batch, seed=seed)
    td = env.reset()
    position, energy = td[keys.POSITION].clone(), td[keys.ENERGY].clone()
    position[0, 0], energy[0, 0] = env.slots[td[keys.SLOT][0, 0, 0]], config.energy_max - 1e-3
    td = env.set_state(position, energy)
    generator = torch.Generator().manual_seed(seed)
    actions = [
        config.max_speed * torch.randn(td[keys.POSITION].shape, generator=generator, dtype=torch.float64) for _ in "ab"
    ]
    actions[0][0, 0] = 0  # it stays there
    return config, env, td, *actions


def by_hand(config, env, td, own, others, b, i):
    """Features of robot i in world b, one number after the other."""
    n, way = config.n_agents, STEPS * config.dt
    coarse = SurveillanceEnv(
        SurveillanceConfig(**(vars(config) | {"resolution": POINTS_PER_AXIS[config.dimension]})), len(own)
    )
    places = [td[keys.POSITION][b, j] + way * (own if j == i else others)[b, j] for j in range(n)]
    features = []
    for k in range(n):
        j = (i + k) % n
        distance = min(float((places[j] - torch.tensor(s, dtype=own.dtype)).norm()) for s in config.station_positions)
        t = (config.charge_radius - distance) / (config.charge_radius - config.charge_radius_full)
        t = min(max(t, 0.0), 1.0)
        energy = float(td[keys.ENERGY][b, j]) + way * (config.charge_rate * t * t * (3 - 2 * t) - config.drain_rate)
        features.append(min((energy - config.energy_min) / (config.energy_max - config.energy_min), 1.0))
    density = coarse.density
    if config.density == "age":
        weights = torch.full(
            (len(density.points),), 1 / len(density.points), dtype=own.dtype
        )  # nothing has aged at the start
    else:
        params = td[keys.DENSITY] if density.n_params else own.new_zeros(len(own), 0)
        weights = density.weights(params).expand(len(own), -1)[b]
    cost = sum(
        float(w) * min(float((place - q).square().sum()) for place in places)
        for w, q in zip(weights, density.points, strict=True)
    )
    return [*features, 2 * (cost + density.cell_moment) / env.reference_cost]


@WORLDS
def test_features_are_the_batteries_and_the_cost_that_the_actions_lead_to(fields):
    config, env, td, own, others = start(2, **fields)
    features = Foresight(config, STEPS)(td[keys.OBSERVATION], own, others)
    same = Foresight(config, STEPS)(td[keys.OBSERVATION], own, own)
    assert (
        features.shape == (2, config.n_agents, config.n_agents + 1) == (*own.shape[:2], Foresight(config, 1).n_features)
    )
    for b in range(2):
        for i in {0, config.n_agents - 1}:
            expected = by_hand(config, env, td, own, others, b, i)
            assert features[b, i].tolist() == pytest.approx(expected, rel=1e-9)
            assert same[b, i].tolist() == pytest.approx(by_hand(config, env, td, own, own, b, i), rel=1e-9)


@WORLDS
def test_slopes_match_finite_differences(fields):
    config, _, td, own, others = start(6, **fields)
    foresight, observation = Foresight(config, STEPS), td[keys.OBSERVATION]
    generator = torch.Generator().manual_seed(3)
    weight, way = (
        torch.randn(shape, generator=generator, dtype=own.dtype) for shape in ((config.n_agents + 1,), own.shape)
    )

    def total(action, rest):
        return (foresight(observation, action, action if rest is None else rest) @ weight).sum()

    for rest in (others, None):  # None: every robot's action in all rows
        action = own.clone().requires_grad_()
        (slope,) = torch.autograd.grad(total(action, rest), action)
        h = 1e-7 * config.max_speed
        numeric = (total(own + h * way, rest) - total(own - h * way, rest)) / (2 * h)
        assert float((slope * way).sum()) == pytest.approx(float(numeric), rel=1e-5)


def test_cost_ahead_is_the_worlds_own():
    """The cost of a step without a filter, to the error of the coarse quadrature."""
    config, env, td, own, _ = start(64, on_violation="continue")
    own = 0.5 * own.clamp(-config.max_speed, config.max_speed)
    seen = Foresight(config, 1)(td[keys.OBSERVATION], own, own)[..., -1]
    after = env.step(td.set(keys.ACTION, own))["next"][keys.COVERAGE_COST] * 2 / env.reference_cost
    assert (seen - after).abs().max() < 0.02 * after.mean()
    assert (seen - after).abs().mean() < 0.005 * after.mean()


def test_robots_in_one_place_have_finite_slopes():
    points = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    own = torch.zeros(1, 3, 2, dtype=torch.float64, requires_grad=True)
    cost = cost_of_own(own, own.detach(), points, torch.full((50,), 0.02, dtype=torch.float64))
    cost.sum().backward()
    assert torch.allclose(cost, points.square().sum(-1).mean().expand(1, 3))
    assert own.grad.isfinite().all()


@pytest.mark.parametrize("algorithm", ["maddpg", "ddpg"])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_critic_reads_the_same_from_joint_and_separate_actions(algorithm, n):
    config, env, td, own, others = start(n_agents=n)
    critic = Critic(env.n_observation, config, AgentConfig(algorithm=algorithm, critic_cells=[8]))
    joint = joint_action(own, others, centralized=algorithm == "maddpg")
    values = critic.values(td[keys.OBSERVATION], own, others)
    torch.testing.assert_close(critic(td[keys.OBSERVATION], joint), values, rtol=1e-12, atol=1e-12)
    if algorithm == "ddpg":  # independent critics do not know what the others do
        assert torch.equal(critic.values(td[keys.OBSERVATION], own, torch.zeros_like(own)), values)


@pytest.mark.parametrize("gradient", ["per_agent", "shared"])
def test_actor_gradient_with_foresight_matches_finite_differences(gradient):
    torch.manual_seed(0)
    config = SurveillanceConfig(dtype="float64")
    agent = AgentConfig(actor_cells=[8], critic_cells=[8], share_params=True, gradient=gradient)
    env = SurveillanceEnv(config, 16, seed=0)
    actor, critic = (make(env.n_observation, config, agent) for make in (make_actor, make_critic))
    _, explore = make_policies(actor, config, SafetyConfig(), agent, 0, torch.device("cpu"))
    with torch.no_grad():
        batch = to_transitions(env.rollout(4, explore)).reshape(-1)
    loss, _ = make_loss(actor, critic, agent, SafetyConfig(), config)
    weight = loss.actor_network_params["module", "0", "module", "net", "params", "2", "weight"]

    def objective():
        return loss(batch)["loss_actor"].sum()

    objective().backward()
    slope = float(weight.grad[0, 1])
    h = 1e-6
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            weight[0, 1] += sign * h
            values.append(float(objective()))
            weight[0, 1] -= sign * h
    assert slope == pytest.approx((values[0] - values[1]) / (2 * h), rel=1e-4)
    assert slope != 0


def test_critic_without_foresight_or_with_all_observations_is_of_another_size():
    config = SurveillanceConfig()
    sizes = {}
    for state in ("own", "concatenated"):
        for foresight in (0, STEPS):
            critic = Critic(18, config, AgentConfig(critic_state=state, foresight=foresight))
            sizes[state, foresight > 0] = critic.net.params["0"]["weight"].shape[-1]
    assert sizes == {
        ("own", False): 18 + 6,
        ("own", True): 18 + 6 + 4,
        ("concatenated", False): 3 * 18 + 6,
        ("concatenated", True): 3 * 18 + 6 + 4,
    }


def test_age_is_seen_as_coarse_cells():
    """Foresight knows of the ages what a robot observes: the mean of each coarse cell."""
    config, env, td, own, _ = start(2, density="age", horizon=0)
    for _ in range(30):
        td = env.step(td.set(keys.ACTION, torch.zeros_like(own)))["next"]
    density = Foresight(config, STEPS)._tools(own)[0]
    seen = density.weights_seen(density.observe(torch.rand(1, 100, dtype=own.dtype)))
    assert seen.shape == (1, 100)
    assert float(seen.sum()) == pytest.approx(1)
    fine = Foresight(config, STEPS)(td[keys.OBSERVATION], torch.zeros_like(own), torch.zeros_like(own))[:, 0, -1]
    exact = td[keys.COVERAGE_COST].squeeze(-1) * 2 / env.reference_cost
    assert (fine - exact).abs().max() < 0.05 * exact.mean()
