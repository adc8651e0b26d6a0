"""The MADDPG update against networks and formulas written out here, robot by robot, on batches from the environment."""

import copy
import itertools

import pytest
import torch
from torchrl.objectives import DDPGLoss, SoftUpdate

from agents import AgentConfig
from agents.maddpg import make_loss, make_optimizers, reduce_robots, update_step
from agents.networks import STATE_ACTION_VALUE, make_actor, make_critic, make_policies
from agents.pipeline import MultiStep, collect, to_transitions
from agents.replay import Replay
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)
N, D = 3, 2
SMALL = {"actor_cells": [8], "critic_cells": [8, 6], "critic_action": "executed", "gamma": 0.95, "initial_reward": 0.0}
SMALL |= {"critic_state": "concatenated", "foresight": 0}
NEXT_TERMINATED = ("next", *keys.TERMINATED)
NEXT_DONE = ("next", *keys.DONE)


class Setup:
    """World, networks, losses and one batch of 80 transitions, all in float64."""

    def __init__(self, *, safety=None, speed_up=1.0, **agent):
        torch.manual_seed(0)
        self.world = SurveillanceConfig(dtype="float64", reset_reserve=0.0)
        self.agent = AgentConfig(**(SMALL | agent))
        self.safety = SafetyConfig(**(safety or {}))
        env = SurveillanceEnv(self.world, 8, seed=0)
        self.actor = make_actor(env.n_observation, self.world, self.agent)
        self.critic = make_critic(env.n_observation, self.world, self.agent)
        _, explore = make_policies(self.actor, self.world, self.safety, self.agent, 0, torch.device("cpu"))
        with torch.no_grad():
            self.actor.module.net.params["2"]["weight"].mul_(speed_up)
            self.batch = to_transitions(env.rollout(10, explore, break_when_any_done=False)).reshape(-1)
        assert self.batch.shape == (80,)
        self.loss, self.updater = make_loss(self.actor, self.critic, self.agent, self.safety, self.world)
        with torch.no_grad():  # let online and target networks differ
            for params in (self.loss.target_actor_network_params, self.loss.target_value_network_params):
                for p in params.values(True, True):
                    p.add_(
                        0.1 * torch.randn(p.shape, generator=torch.Generator().manual_seed(p.numel()), dtype=p.dtype)
                    )

    def networks(self, which):
        """``(actor layers, critic layers)``, lists of (weight, bias), of the "online" or the "target" networks."""
        prefix = "" if which == "online" else "target_"
        found = []
        for name, child in (("actor", "0"), ("value", "1")):
            params = getattr(self.loss, f"{prefix}{name}_network_params")["module", child, "module", "net", "params"]
            numbers = sorted(set(params.keys()), key=int)
            found.append([(params[k]["weight"], params[k]["bias"]) for k in numbers])
        return found

    def act(self, layers, observation):
        """Actions of all robots by hand, ``(B, N, d)``."""
        actions = []
        for i in range(N):
            z = mlp(layers, i, observation[:, i])
            norm = z.norm(dim=-1, keepdim=True)
            actions.append(self.world.max_speed * norm.tanh() * z / norm)
        return torch.stack(actions, 1)

    def value(self, layers, i, observation, action):
        """``Q_i`` by hand, ``(B,)``: robot i first, the others in cyclic order."""
        action = action / self.world.max_speed
        if self.agent.algorithm == "ddpg":
            return mlp(layers, i, torch.cat([observation[:, i], action[:, i]], -1)).squeeze(-1)
        order = [(i + k) % N for k in range(N)]
        return mlp(layers, i, torch.cat([observation[:, order].flatten(1), action[:, order].flatten(1)], -1)).squeeze(
            -1
        )

    def filtered(self, nominal, td):
        """Filter on the states of ``td``: action and correction ``(B, N)``."""
        state = (td[keys.POSITION], td[keys.ENERGY].squeeze(-1), td[keys.SLOT].squeeze(-1))
        action, _, correction, *_ = SafetyFilter(self.safety, self.world).filter(nominal, *state)
        return action, correction.squeeze(-1)

    def gradients(self, loss):
        """Gradient of the actors' parameters, layer by layer; each ``(N, ...)``."""
        for p in self.loss.parameters():
            p.grad = None
        loss.backward(retain_graph=True)
        params = self.loss.actor_network_params
        return [torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in params.values(True, True)]


def mlp(layers, i, x):
    for k, (weight, bias) in enumerate(layers):
        x = x @ weight[i].T + bias[i]
        x = x.relu() if k + 1 < len(layers) else x
    return x


def leaves(layers):
    return [(w.detach().clone().requires_grad_(), b.detach().clone().requires_grad_()) for w, b in layers]


# ---- actor -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("algorithm", ["maddpg", "ddpg"])
def test_actor_gradient_is_the_papers(algorithm):
    s = Setup(algorithm=algorithm)
    actor, critic = s.networks("online")
    actor, observation, replay = leaves(actor), s.batch[keys.OBSERVATION], s.batch[keys.ACTION]
    total = 0
    for i in range(N):
        action = replay.clone()
        action[:, i] = s.act(actor, observation)[:, i]
        total = total - s.value(critic, i, observation, action).mean()
    total.backward()
    loss = s.loss(s.batch)["loss_actor"]
    assert loss.shape == (80, N)
    torch.testing.assert_close(loss.mean(0).sum(), total)
    expected = {tuple(p.shape): p.grad for layer in actor for p in layer}
    for got in s.gradients(loss.mean(0).sum()):
        assert got.abs().max() > 0
        torch.testing.assert_close(got, expected[tuple(got.shape)])


@pytest.mark.parametrize(("gradient", "crosses"), [("per_agent", False), ("shared", True)])
def test_critic_of_another_robot_reaches_an_actor_only_if_asked(gradient, crosses):
    s = Setup(gradient=gradient)
    loss = s.loss(s.batch)["loss_actor"]
    for j in range(N):
        for gradient_of_j in s.gradients(loss[:, j].mean()):
            per_robot = gradient_of_j.flatten(1).abs().sum(1)
            assert per_robot[j] > 0
            for i in set(range(N)) - {j}:
                assert (per_robot[i] > 0) == crosses


def test_shared_gradient_recomputes_all_actions():
    s = Setup(gradient="shared")
    actor, critic = s.networks("online")
    action = s.act(actor, s.batch[keys.OBSERVATION])
    expected = torch.stack([-s.value(critic, i, s.batch[keys.OBSERVATION], action) for i in range(N)], 1)
    torch.testing.assert_close(s.loss(s.batch)["loss_actor"], expected)


@pytest.mark.parametrize("share", [False, True])
def test_shared_gradient_is_torchrls_loss(share):
    """After updates, a load and a copy as well: the losses read the parameters that are in force."""
    s, other = (Setup(gradient="shared", share_params=share) for _ in range(2))

    def agree(loss):
        mine, theirs = loss(s.batch), DDPGLoss.forward(loss, s.batch.clone())
        for name in ("loss_value", "pred_value", "target_value"):
            torch.testing.assert_close(mine[name], theirs[name].squeeze(-1) if theirs[name].dim() > 2 else theirs[name])
        actor = DDPGLoss.loss_actor(loss, s.batch.clone())[0]
        torch.testing.assert_close(mine["loss_actor"], actor)
        return mine["loss_value"]

    first, optimizers = agree(s.loss), make_optimizers(s.loss, s.agent)
    for _ in range(3):
        update_step(s.batch, s.loss, optimizers, s.updater, s.agent)
    second = agree(s.loss)
    assert not torch.allclose(first, second)
    other.loss.load_state_dict(s.loss.state_dict())
    torch.testing.assert_close(agree(other.loss), second)
    twin = copy.deepcopy(s.loss)
    update_step(s.batch, s.loss, optimizers, s.updater, s.agent)
    torch.testing.assert_close(agree(twin), second)
    third = agree(s.loss)
    assert not torch.allclose(third, second)
    update_step(s.batch, twin, make_optimizers(twin, s.agent), SoftUpdate(twin, tau=s.agent.tau), s.agent)
    moved = twin(s.batch)["loss_value"]  # TorchRL's own losses do not follow a copy
    assert not torch.allclose(moved, second)
    torch.testing.assert_close(agree(s.loss), third)


def test_losses_reach_their_own_networks_only():
    s = Setup()
    for name, own, other in (
        ("loss_actor", s.loss.actor_network_params, s.loss.value_network_params),
        ("loss_value", s.loss.value_network_params, s.loss.actor_network_params),
    ):
        s.gradients(s.loss(s.batch)[name].mean(0).sum())
        assert all(p.grad is not None and p.grad.abs().max() > 0 for p in own.values(True, True))
        assert all(p.grad is None or (p.grad == 0).all() for p in other.values(True, True))
    for params in (s.loss.target_actor_network_params, s.loss.target_value_network_params):
        assert not any(p.requires_grad for p in params.values(True, True))


# ---- critic ----------------------------------------------------------------------------------------------------------
def target_by_hand(s, terminated, *, safe=False):
    actor, critic = s.networks("target")
    following = s.batch["next"]
    observation = following[keys.OBSERVATION]
    action = s.act(actor, observation)
    action = s.filtered(action, following)[0] if safe else action
    future = torch.stack([s.value(critic, i, observation, action) for i in range(N)], 1)
    return following[keys.REWARD].squeeze(-1) + s.agent.gamma * future * (1 - terminated.double())


@pytest.mark.parametrize("algorithm", ["maddpg", "ddpg"])
def test_critic_target_and_loss(algorithm):
    s = Setup(algorithm=algorithm, gamma=0.9)
    terminated = torch.zeros(80, N, 1, dtype=torch.bool)
    terminated[::3] = True
    truncated = torch.zeros(80, N, 1, dtype=torch.bool)
    truncated[1::3] = True
    s.batch[NEXT_TERMINATED], s.batch[NEXT_DONE] = terminated, terminated | truncated
    expected = target_by_hand(s, terminated.squeeze(-1))
    out = s.loss(s.batch)
    torch.testing.assert_close(out["target_value"], expected)
    assert torch.equal(out["target_value"][::3], s.batch["next"][keys.REWARD].squeeze(-1)[::3])
    _, critic = s.networks("online")
    observation, action = s.batch[keys.OBSERVATION], s.batch[keys.ACTION]
    value = torch.stack([s.value(critic, i, observation, action) for i in range(N)], 1)
    torch.testing.assert_close(out["pred_value"], value)
    torch.testing.assert_close(out["loss_value"], (value - expected).square())


def test_time_limit_does_not_cut_the_bootstrap():
    s = Setup()
    s.batch[NEXT_TERMINATED] = torch.zeros(80, N, 1, dtype=torch.bool)
    s.batch[NEXT_DONE] = torch.zeros(80, N, 1, dtype=torch.bool)
    running = s.loss(s.batch)["target_value"]
    s.batch[NEXT_DONE] = torch.ones(80, N, 1, dtype=torch.bool)
    assert torch.equal(s.loss(s.batch)["target_value"], running)
    s.batch[NEXT_TERMINATED] = torch.ones(80, N, 1, dtype=torch.bool)
    assert not torch.allclose(s.loss(s.batch)["target_value"], running)


def nudge(params):
    with torch.no_grad():
        for p in params.values(True, True):
            p.add_(0.05)


@pytest.mark.parametrize(
    ("name", "moves"),
    [
        ("actor_network_params", False),
        ("value_network_params", False),
        ("target_actor_network_params", True),
        ("target_value_network_params", True),
    ],
)
def test_target_value_comes_from_the_target_networks(name, moves):
    s = Setup()
    before = s.loss(s.batch)["target_value"]
    nudge(getattr(s.loss, name))
    assert torch.allclose(s.loss(s.batch)["target_value"], before) != moves


# ---- update ----------------------------------------------------------------------------------------------------------
def test_targets_follow_softly():
    s = Setup(tau=0.2)
    optimizers = make_optimizers(s.loss, s.agent)
    pairs = [
        (getattr(s.loss, f"{name}_network_params"), getattr(s.loss, f"target_{name}_network_params"))
        for name in ("actor", "value")
    ]
    online_before = [online.clone() for online, _ in pairs]
    before = [target.clone() for _, target in pairs]
    metrics = update_step(s.batch, s.loss, optimizers, s.updater, s.agent)
    for (online, target), old, start in zip(pairs, before, online_before, strict=True):
        for key, value in target.items(True, True):
            torch.testing.assert_close(value, 0.8 * old[key] + 0.2 * online[key].detach())
            assert (online[key] != start[key]).any()  # both networks were updated
    assert set(metrics.keys()) >= {"actor", "value", "q_value", "target", "grad_norm_actor", "grad_norm_value"}
    assert all(value.isfinite() and not value.requires_grad for value in metrics.values())


def test_update_moves_each_network_by_its_own_rate():
    # Adam's first step is the learning rate, whatever the gradient
    s = Setup(actor_lr=1e-3, critic_lr=1e-2)
    groups = {name: getattr(s.loss, f"{name}_network_params") for name in ("actor", "value")}
    start = {name: params.clone() for name, params in groups.items()}
    update_step(s.batch, s.loss, make_optimizers(s.loss, s.agent), s.updater, s.agent)
    for name, rate in (("actor", 1e-3), ("value", 1e-2)):
        moved = [(p - start[name][key]).abs().max().item() for key, p in groups[name].items(True, True)]
        assert moved == pytest.approx([rate] * len(moved), rel=1e-2)


def test_critics_fit_a_fixed_batch():
    s = Setup(gamma=0.5, critic_lr=3e-3)
    optimizers = make_optimizers(s.loss, s.agent)
    history = [update_step(s.batch, s.loss, optimizers, s.updater, s.agent)["value"] for _ in range(50)]
    assert history[-1] < 0.2 * history[0]


def test_actors_climb_fixed_critics():
    s = Setup(critic_lr=1e-12, actor_lr=3e-3)
    optimizers = make_optimizers(s.loss, s.agent)
    history = [update_step(s.batch, s.loss, optimizers, s.updater, s.agent)["actor"] for _ in range(20)]
    assert all(later < earlier for earlier, later in itertools.pairwise(history))


def test_gradient_norm_is_clipped_on_request():
    metrics = {}
    for limit in (0.0, 1e-3):
        s = Setup(max_grad_norm=limit)
        metrics[limit] = update_step(s.batch, s.loss, make_optimizers(s.loss, s.agent), s.updater, s.agent)
        norm = torch.stack([p.grad.norm() for p in s.loss.value_network_params.values(True, True)]).norm()
        reported = metrics[limit]["grad_norm_value"]
        torch.testing.assert_close(norm, torch.tensor(limit).double() if limit else reported, rtol=1e-3, atol=1e-9)
    torch.testing.assert_close(metrics[0.0]["grad_norm_value"], metrics[1e-3]["grad_norm_value"])


def test_minibatches_of_their_own():
    loss = torch.randn(N * 5, N, generator=torch.Generator().manual_seed(0))
    own = sum(loss[5 * i : 5 * (i + 1), i].mean() for i in range(N))
    torch.testing.assert_close(reduce_robots(loss, AgentConfig(minibatch="per_agent")), own)
    torch.testing.assert_close(reduce_robots(loss, AgentConfig()), sum(loss[:, i].mean() for i in range(N)))


def test_update_with_minibatches_of_their_own():
    s = Setup(minibatch="per_agent", tau=1e-9, gamma=0.5)
    batch = s.batch[: 3 * 20]
    s.loss.zero_grad()
    alone = [s.gradients(s.loss(batch[20 * i : 20 * (i + 1)])["loss_actor"][:, i].mean()) for i in range(N)]
    got = s.gradients(reduce_robots(s.loss(batch)["loss_actor"], s.agent))
    for layer, gradient in enumerate(got):
        torch.testing.assert_close(gradient, torch.stack([alone[i][layer][i] for i in range(N)]))


# ---- the filter inside the loss --------------------------------------------------------------------------------------
def fast(**safety):
    """Actors at nearly full speed on states with little energy to spare: the filter corrects some of them."""
    return Setup(safety=safety, speed_up=60.0)


def test_filter_in_the_loss_filters_policy_and_target():
    s = fast(in_loss=True)
    actor, critic = s.networks("online")
    nominal = s.act(actor, s.batch[keys.OBSERVATION]).detach()
    safe, correction = s.filtered(nominal, s.batch)
    assert (correction > 1e-3).sum() >= 5
    assert (correction == 0).sum() >= 5
    out = s.loss(s.batch)
    for i in range(N):
        action = s.batch[keys.ACTION].clone()
        action[:, i] = safe[:, i]
        expected = -s.value(critic, i, s.batch[keys.OBSERVATION], action)
        torch.testing.assert_close(out["loss_actor"][:, i], expected)
    terminated = s.batch[NEXT_TERMINATED].squeeze(-1)
    torch.testing.assert_close(out["target_value"], target_by_hand(s, terminated, safe=True))
    assert not torch.allclose(out["target_value"], target_by_hand(s, terminated))


def test_gradient_flows_through_the_filter():
    inside, outside = fast(in_loss=True), fast()
    nominal = inside.act(inside.networks("online")[0], inside.batch[keys.OBSERVATION]).detach()
    _, correction = inside.filtered(nominal, inside.batch)
    for i in range(N):
        free, corrected = correction[:, i] == 0, correction[:, i] > 1e-3
        assert free.any()
        for rows, same in ((free, True), (corrected, False)):
            if not rows.any():
                continue
            a, b = (s.gradients(s.loss(s.batch)["loss_actor"][rows, i].sum()) for s in (inside, outside))
            equal = [torch.allclose(x[i], y[i], rtol=1e-6, atol=1e-12) for x, y in zip(a, b, strict=True)]
            assert all(equal) == same
            assert all(x.isfinite().all() for x in a)
            assert not same or a[0][i].abs().max() > 0
    assert (correction > 1e-3).any(0).sum() >= 2


def test_gradient_in_the_loss_matches_finite_differences():
    s = fast(in_loss=True)
    weight = s.loss.actor_network_params["module", "0", "module", "net", "params", "2", "bias"]
    objective = s.loss(s.batch)["loss_actor"].mean(0).sum()
    s.gradients(objective)
    analytic, step = weight.grad.clone(), 1e-6
    for index in ((0, 0), (1, 1), (2, 0)):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                weight[index] += sign * step
                values.append(s.loss(s.batch)["loss_actor"].mean(0).sum())
                weight[index] -= sign * step
        assert analytic[index].item() == pytest.approx((values[0] - values[1]).item() / (2 * step), rel=2e-3, abs=1e-6)


def test_joint_filter_in_the_loss_keeps_neighbours_detached():
    s = fast(in_loss=True, mode="paper", split="joint")
    s.batch = s.batch[::8]
    loss = s.loss(s.batch)["loss_actor"]
    assert loss.isfinite().all()
    for j in range(N):
        for gradient in s.gradients(loss[:, j].mean()):
            per_robot = gradient.flatten(1).abs().sum(1)
            assert per_robot[j] > 0
            assert all(per_robot[i] == 0 for i in range(N) if i != j)


def test_correction_penalty():
    plain, penal = fast(in_loss=True), Setup(safety={"in_loss": True}, speed_up=60.0, correction_penalty=0.7)
    nominal = plain.act(plain.networks("online")[0], plain.batch[keys.OBSERVATION]).detach()
    _, correction = plain.filtered(nominal, plain.batch)
    extra = penal.loss(penal.batch)["loss_actor"] - plain.loss(plain.batch)["loss_actor"]
    torch.testing.assert_close(extra, 0.7 * (correction / plain.world.max_speed) ** 2)
    assert extra.max() > 1e-3
    a, b = (s.gradients(s.loss(s.batch)["loss_actor"].sum()) for s in (penal, plain))
    assert not torch.allclose(a[0], b[0])
    assert all(x.isfinite().all() for x in a)


def test_correction_penalty_needs_the_filter_in_the_loss():
    with pytest.raises(ValueError, match=r"agent\.correction_penalty=0\.5.*safety\.in_loss=true"):
        Setup(correction_penalty=0.5)


# ---- values of nominal actions -----------------------------------------------------------------------------------------
def test_nominal_actions_are_valued_on_request():
    nominal, executed = (Setup(noise_initial=3.0, critic_action=kind) for kind in ("nominal", "executed"))
    batch, speed = nominal.batch, nominal.world.max_speed
    action = batch[keys.NOMINAL_ACTION]
    norm = action.norm(dim=-1, keepdim=True)
    assert (norm > 1.5 * speed).any()  # explored actions are cut to the speed ball
    action = torch.where(norm > speed, action * speed / norm, action)
    assert (action - batch[keys.ACTION]).norm(dim=-1).max() > 0.5 * speed  # the filter had something to do
    for s, kind in ((nominal, "nominal"), (executed, "executed")):
        actor, critic = s.networks("online")
        taken = action if kind == "nominal" else batch[keys.ACTION]
        out = s.loss(batch)
        policy = s.act(actor, batch[keys.OBSERVATION])
        for i in range(N):
            value = s.value(critic, i, batch[keys.OBSERVATION], taken)
            torch.testing.assert_close(out["pred_value"][:, i], value, rtol=1e-5, atol=1e-5)
            own = taken.clone()
            own[:, i] = policy[:, i]
            expected = -s.value(critic, i, batch[keys.OBSERVATION], own)
            torch.testing.assert_close(out["loss_actor"][:, i], expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(nominal.batch[keys.ACTION], executed.batch[keys.ACTION])  # the batch itself stays


def test_auto_values_executed_actions_only_with_the_filter_in_the_loss():
    values = {}
    for kind, safety in (("auto", {}), ("nominal", {}), ("executed", {}), ("auto", {"in_loss": True})):
        s = Setup(noise_initial=3.0, critic_action=kind, safety=safety)
        values[kind, bool(safety)] = s.loss(s.batch)["pred_value"]
    assert torch.equal(values["auto", False], values["nominal", False])
    assert torch.equal(values["auto", True], values["executed", False])
    assert not torch.allclose(values["auto", False], values["auto", True])


def test_nominal_actions_do_not_go_with_the_filter_in_the_loss():
    with pytest.raises(
        ValueError, match=r"safety\.in_loss=true.*agent\.critic_action=nominal must be executed or auto"
    ):
        Setup(critic_action="nominal", safety={"in_loss": True})


# ---- n-step targets ------------------------------------------------------------------------------------------------------
def test_n_step_transitions_and_targets():
    n, gamma, worlds, steps = 3, 0.9, 4, 23
    world = SurveillanceConfig(dtype="float64", horizon=8)
    env = SurveillanceEnv(world, worlds, seed=0)
    agent = AgentConfig(**(SMALL | {"gamma": gamma, "n_steps": n}))
    torch.manual_seed(0)
    actor, critic = (make(env.n_observation, world, agent) for make in (make_actor, make_critic))
    _, explore = make_policies(actor, world, SafetyConfig(), agent, 0, torch.device("cpu"))
    with torch.no_grad():
        rollout = to_transitions(env.rollout(steps, explore, break_when_any_done=False))
    rollout["next"][keys.REWARD] = torch.randn(worlds, steps, N, 1, dtype=torch.float64)
    ends = [t for t in range(steps) if (t + 1) % 8 == 0]
    multi_step, parts = MultiStep(n, gamma), []
    for first, last in ((0, 2), (2, 3), (3, 9), (9, steps)):  # batches of any length
        parts.append(multi_step(rollout[:, first:last]))
    assert [len(p) // worlds for p in parts] == [0, 1, 6, steps - 9]
    merged = torch.cat(parts[1:])
    assert len(merged) == worlds * (steps - n + 1)
    by_position = {tuple(row[keys.POSITION].flatten().tolist()): row for row in merged}
    loss, _ = make_loss(actor, critic, agent, SafetyConfig(), world)
    for b, t in itertools.product(range(worlds), range(steps - n + 1)):
        row = by_position[tuple(rollout[b, t][keys.POSITION].flatten().tolist())]
        last = min([t + n - 1] + [e for e in ends if e >= t])
        assert (row["steps_to_next_obs"] == last - t + 1).all()
        expected = sum(gamma**k * rollout["next"][keys.REWARD][b, t + k] for k in range(last - t + 1))
        torch.testing.assert_close(row["next"][keys.REWARD], expected)
        for key in (keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT, keys.DONE, keys.TERMINATED):
            assert torch.equal(row["next"][key], rollout["next"][key][b, last])
        assert torch.equal(row[keys.ACTION], rollout[keys.ACTION][b, t])
    out = loss(merged)
    following = merged["next"].clone().select(keys.OBSERVATION)
    with loss.target_actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
        following = loss.actor_network(following)
    with loss.target_value_network_params.to_module(loss.value_network, preserve_module_state=False):
        future = loss.value_network(following)[STATE_ACTION_VALUE]
    expected = merged["next"][keys.REWARD] + gamma ** merged["steps_to_next_obs"] * future
    torch.testing.assert_close(out["target_value"], expected.squeeze(-1))


def test_n_step_transition_ends_with_a_violation():
    reward = torch.tensor([1.0, 10.0, 100.0, 1000.0, 1e4, 1e5]).view(1, 6, 1, 1).expand(1, 6, N, 1).clone()
    s = Setup()
    rollout = s.batch[:6].clone().reshape(1, 6)
    rollout["next"][keys.REWARD] = reward.double()
    flag = torch.zeros(1, 6, 1, dtype=torch.bool)
    flag[0, 1] = True
    for key in (("next", "done"), NEXT_DONE, NEXT_TERMINATED):
        rollout[key] = flag if key == ("next", "done") else flag.unsqueeze(-1).expand(1, 6, N, 1).clone()
    merged = MultiStep(3, 0.5)(rollout)
    assert merged["next"][keys.REWARD][:, 0, 0].tolist() == [1 + 5.0, 10.0, 100 + 500 + 2500, 1000 + 5e3 + 2.5e4]
    assert merged[NEXT_TERMINATED][:, 0, 0].tolist() == [True, True, False, False]
    assert merged["next", "done"].flatten().tolist() == [True, True, False, False]


def test_n_steps_survive_any_stream():
    """Random ends, batch lengths, discounts 0 and 1 - included: against a loop over worlds and steps."""
    generator = torch.Generator().manual_seed(0)
    s = Setup()
    for n, gamma, share in ((2, 0.5, 0.3), (5, 0.9, 0.0), (7, 0.0, 0.1), (4, 1.0, 1.0)):
        rollout = s.batch.reshape(8, 10).clone()
        reward = torch.randn(8, 10, N, 1, dtype=torch.float64, generator=generator)
        done = torch.rand(8, 10, 1, generator=generator) < share
        rollout["next"][keys.REWARD], rollout["next", "done"] = reward, done
        multi_step = MultiStep(n, gamma)
        merged = torch.cat(
            [part for k in (0, 1, 4, 9) if len(part := multi_step(rollout[:, k : {0: 1, 1: 4, 4: 9, 9: 10}[k]]))]
        )
        assert len(merged) == 8 * (10 - n + 1)
        found = {row[keys.OBSERVATION].sum().item(): row for row in merged}
        for b, t in itertools.product(range(8), range(10 - n + 1)):
            total, last = 0.0, t
            for k in range(n):
                last = t + k
                total = total + gamma**k * reward[b, last]
                if done[b, last]:
                    break
            row = found[rollout[b, t][keys.OBSERVATION].sum().item()]
            torch.testing.assert_close(row["next"][keys.REWARD], total)
            assert torch.equal(row["next"][keys.OBSERVATION], rollout["next"][keys.OBSERVATION][b, last])
            assert (row["steps_to_next_obs"] == last - t + 1).all()


def test_one_step_passes_through():
    s = Setup()
    rollout = s.batch.reshape(8, 10)
    assert (MultiStep(1, 0.9)(rollout) == s.batch).all()


# ---- what is stored --------------------------------------------------------------------------------------------------
def test_transitions_hold_the_executed_action_and_all_the_filter_reads():
    s = Setup(noise_initial=3.0)
    assert not torch.allclose(s.batch[keys.ACTION], s.batch[keys.NOMINAL_ACTION])
    for td in (s.batch, s.batch["next"]):
        assert all(key in td.keys(True) for key in (keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT))
    moved = s.batch[keys.POSITION] + s.world.dt * s.batch[keys.ACTION]
    torch.testing.assert_close(moved, s.batch["next"][keys.POSITION])


def test_violation_penalty_is_charged_to_the_violator():
    reward = torch.full((2, 3, N, 1), -1.0)
    flags = torch.zeros(2, 3, N, 1, dtype=torch.bool)
    flags[1, 2, 0] = True
    s = Setup()
    batch = s.batch[:6].clone().reshape(2, 3)
    batch["next"][keys.REWARD] = reward
    for kind in keys.VIOLATION_KINDS:
        batch["next"][(*keys.VIOLATION, kind)] = flags if kind in ("collision", "stranded") else torch.zeros_like(flags)
    got = to_transitions(batch, violation_penalty=5.0)["next"][keys.REWARD]
    expected = torch.full((2, 3, N, 1), -1.0)
    expected[1, 2, 0] = -11.0
    assert torch.equal(got, expected)
    assert (to_transitions(batch)["next"][keys.REWARD] == -1).all()


@pytest.mark.parametrize("compile_functions", [False, True])
def test_where_rollouts_are_computed(compile_functions):
    env = SurveillanceEnv(SurveillanceConfig(), 2, compile_functions=compile_functions)
    with env.without_gradients():
        assert not torch.is_grad_enabled()
        assert torch.is_inference_mode_enabled() == (not compile_functions)


def test_rows_are_for_gradients_though_rollouts_are_not():
    s = Setup()
    env = SurveillanceEnv(s.world, 4)
    _, explore = make_policies(s.actor, s.world, s.safety, s.agent, 0, torch.device("cpu"))
    for steps in (1, 2):
        replay = Replay(100, [0], torch.device("cpu"))
        for batch in collect(env, explore, 4 * steps, 4 * steps):
            assert env.state["position"].is_inference()
            assert batch.shape == (4, steps)
            replay.store(to_transitions(batch).reshape(-1))
        rows = replay.draw(16, list(replay.tensors))
        assert not any(value.is_inference() for value in rows.values(True, True))
        s.loss(rows)["loss_value"].sum().backward()
        assert all(p.grad is not None for p in s.loss.value_network_params.values(True, True))
        assert not env.reset()[keys.OBSERVATION].is_inference()
