"""fixed_sizes=true: the same actions where the programs decide, driving home where the shield does, and the same promise."""

import copy
import json

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import evaluate
import safety.certificate
import safety.programs
import train
from conf.naming import config_hash
from conf.schema import to_config
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.reassignment import reassign_slots
from envs.selection import places
from safety import QPStatus, SafetyConfig, SafetyFilter
from safety.certificate import HOLD, HOMING
from safety.qp import project_halfspaces_ball
from tests.test_config import composed
from tests.test_qp import problems
from tests.test_synchronisation import Waits
from tests.worlds import COUNT, Adversary, draw_worlds, edge_states, parts, raw_margins, roll_out

WORLDS, _ = draw_worlds(COUNT)
SMALL = [k for k, (world, _) in enumerate(WORLDS) if world.n_agents <= 5]
KINDS_OF_FILTER = [{}, {"split": "half"}, {"mode": "paper"}, {"mode": "dalal", "dalal_steps": 5}, {"mode": "none"}]


class Sizes(TorchDispatchMode):
    """The shapes of everything that is computed, in order."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        self.seen.append((str(func), out.shape if isinstance(out, torch.Tensor) else None))
        return out


def edge(index, batch=24, seed=5):
    """An environment and what the filter reads at edge states: the adversary's actions, positions, energies, slots."""
    world, _ = WORLDS[index]
    env = SurveillanceEnv(world, batch, seed=seed)
    position, energy, slot = edge_states(env, seed)
    return env, (Adversary(world, seed)(position, env.slots[slot]), position, energy, slot)


def filtered(index, inputs, *, fixed_sizes, **fields):
    world, gains = WORLDS[index]
    f = SafetyFilter(SafetyConfig(**{**gains, **fields}), world, fixed_sizes=fixed_sizes)
    return dict(zip(f.out_keys, f.filter(*inputs), strict=True))


# ---- the filter -------------------------------------------------------------------------------------------------------
def test_same_actions_where_the_programs_decide_and_home_where_the_shield_does():
    alike = home = robots = lost = 0
    for index in range(COUNT):
        _, inputs = edge(index)
        chosen, fixed = (filtered(index, inputs, fixed_sizes=f) for f in (False, True))
        unsolved = [x[keys.STATUS] != QPStatus.SOLVED for x in (chosen, fixed)]
        extra = ~unsolved[0] & unsolved[1]  # programs without a closed form within tolerance
        assert (unsolved[1] | ~unsolved[0]).all()
        assert (fixed[keys.LEVEL][extra] >= HOLD).all()
        robots, lost = robots + extra.numel(), lost + int(extra.sum())
        same = (fixed[keys.LEVEL] == chosen[keys.LEVEL]).all(-1)
        others = ~same & ~extra.any(-1)
        assert (fixed[keys.LEVEL][others] == HOMING).all()
        raised = chosen[keys.LEVEL] > unsolved[0].long()  # by the shield: unsolved ones start at hold
        assert raised.any(-1)[others].all()
        tight = {"rtol": 0, "atol": WORLDS[index][0].max_speed * (1e-9 if inputs[1].dtype == torch.float64 else 1e-5)}
        torch.testing.assert_close(fixed[keys.ACTION][same], chosen[keys.ACTION][same], **tight)
        assert torch.equal(fixed[keys.CHARGE_CURRENT], chosen[keys.CHARGE_CURRENT])
        alike, home = alike + int(same.sum()), home + int(others.sum())
    assert alike > 200
    assert home > 10
    assert lost < 0.02 * robots


@pytest.mark.parametrize("fields", KINDS_OF_FILTER, ids=str)
def test_other_filters_and_calm_robots(fields):
    for index in SMALL[:4]:
        _, inputs = edge(index)
        calm = (inputs[0] * 1e-3, *inputs[1:])
        for read in (inputs, calm):
            chosen, fixed = (filtered(index, read, fixed_sizes=f, **fields) for f in (False, True))
            decided = (fixed[keys.LEVEL] == 0) & (chosen[keys.LEVEL] == 0)
            torch.testing.assert_close(
                fixed[keys.ACTION][decided], chosen[keys.ACTION][decided], rtol=0, atol=1e-5, equal_nan=True
            )
            assert decided.double().mean() > 0.3


def test_a_nominal_action_that_is_admissible_passes_bit_for_bit():
    passed = 0
    for index in SMALL:
        _, (nominal, *state) = edge(index)
        fixed = filtered(index, (nominal * 1e-2, *state), fixed_sizes=True)
        kept = fixed[keys.LEVEL] == 0
        kept &= (fixed[keys.CORRECTION].squeeze(-1) == 0) & (nominal.abs() < 1).all(-1)
        assert torch.equal(fixed[keys.ACTION][kept], (nominal * 1e-2)[kept])
        passed += int(kept.sum())
    assert passed > 100


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_broken_nominal_action_holds_and_touches_nobody_else(broken):
    _, (nominal, *state) = edge(SMALL[0])
    before = filtered(SMALL[0], (nominal, *state), fixed_sizes=True)
    nominal = nominal.clone()
    nominal[3, 0, 0] = broken
    after = filtered(SMALL[0], (nominal, *state), fixed_sizes=True)
    assert after[keys.STATUS][3, 0] == QPStatus.INACCURATE
    assert after[keys.LEVEL][3, 0] >= HOLD
    others = torch.arange(len(nominal)) != 3
    assert all(torch.equal(after[key][others], before[key][others]) for key in before)


def test_no_shape_depends_on_the_data():
    world = WORLDS[SMALL[1]][0]
    seen = {}
    for fixed_sizes in (False, True):
        env, inputs = edge(SMALL[1])
        f = SafetyFilter(SafetyConfig(), world, fixed_sizes=fixed_sizes)
        env = SurveillanceEnv(world, 24, seed=0, fixed_sizes=fixed_sizes)
        traces = []
        for scale in (1.0, 1e-3):
            td = env.set_state(inputs[1], inputs[2].unsqueeze(-1), inputs[3].unsqueeze(-1)).set(
                keys.NOMINAL_ACTION, inputs[0] * scale
            )
            f(td.clone())  # constants are made at the first call
            with Sizes() as sizes:
                env.step(f(td))
            traces.append(sizes.seen)
        seen[fixed_sizes] = traces
    assert seen[True][0] == seen[True][1]
    assert seen[False][0] != seen[False][1]


# ---- the promise ------------------------------------------------------------------------------------------------------
def broken_promises(record):
    """Raw violations of a roll-out by kind, and world-steps that left the certified set."""
    d = record.data
    left = (~parts(record.env, d["next_position"], d["next_energy"], d["slot"], 0)).sum()
    return [*(int((margin < 0).sum()) for margin in raw_margins(record)), int(left)]


@pytest.mark.parametrize("index", SMALL[::2])
def test_no_violation_and_no_state_outside_the_set(index):
    record = roll_out(*WORLDS[index], seed=index, steps=24, keep_rows=False, fixed_sizes=True)
    assert broken_promises(record) == [0] * 5
    assert not any(record.data[kind].any() for kind in keys.VIOLATION_KINDS)


def test_the_shield_alone_keeps_the_promise_and_without_it_nothing_does(monkeypatch):
    def careless(target, G, h, radius, **kwargs):
        found = project_halfspaces_ball(target, G, torch.full_like(h, torch.inf), radius, **kwargs)
        return found._replace(status=torch.zeros_like(found.status))

    monkeypatch.setattr(safety.programs, "project_halfspaces_ball", careless)
    levels = torch.zeros(3, dtype=torch.int64)
    for index in SMALL[::3]:
        record = roll_out(*WORLDS[index], seed=index, steps=24, keep_rows=False, fixed_sizes=True)
        assert broken_promises(record) == [0] * 5
        levels += torch.bincount(record.data["level"].flatten(), minlength=3)
    assert levels[HOMING] > 100
    blind = lambda *args, **kwargs: [torch.ones_like(x) for x in real(*args, **kwargs)]  # noqa: E731
    real = safety.certificate.certified_parts
    monkeypatch.setattr(safety.certificate, "certified_parts", blind)
    broken = [broken_promises(roll_out(*WORLDS[k], seed=k, keep_rows=False, fixed_sizes=True)) for k in SMALL[::3]]
    assert torch.tensor(broken).sum() > 0


# ---- programs ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("kind", ["generic", "infeasible"])
def test_programs_are_solved_alike_or_called_inaccurate(n, kind):
    _, p, G, h = problems(400, 7, n, "generic", 3)
    if kind == "infeasible":
        G[::2, 1], h[::2, 0], h[::2, 1] = -G[::2, 0], -3.0 * G[::2, 0].norm(dim=-1), 1.0 * G[::2, 0].norm(dim=-1)
    found = project_halfspaces_ball(-p, G, h, 2.0)
    fixed = project_halfspaces_ball(-p, G, h, 2.0, fixed_sizes=True)
    good = fixed.status == QPStatus.SOLVED
    assert not (good & (found.status != QPStatus.SOLVED)).any()
    assert (good == (found.status == QPStatus.SOLVED)).double().mean() > 0.99
    torch.testing.assert_close(fixed.value[good], found.value[good], rtol=0, atol=1e-7)
    torch.testing.assert_close(fixed.dual[good], found.dual[good], rtol=1e-6, atol=1e-6)
    assert fixed.value.isfinite().all()
    assert (fixed.value.norm(dim=-1) <= 2.0 * (1 + 1e-12)).all()
    assert kind == "generic" or (~good).sum() >= 200


def test_broken_rows_are_set_aside():
    _, p, G, h = problems(6, 4, 2, "generic", 0)
    p[0, 0], G[1, 2, 0], h[2, 1], h[3, 1] = torch.nan, torch.inf, torch.nan, -torch.inf
    fixed = project_halfspaces_ball(-p, G, h, 2.0, fixed_sizes=True)
    whole = project_halfspaces_ball(-p[4:], G[4:], h[4:], 2.0, fixed_sizes=True)
    assert (fixed.status[:4] == QPStatus.INACCURATE).all()
    assert fixed.value.isfinite().all()
    assert torch.equal(fixed.value[4:], whole.value)


def test_gradients_are_the_same():
    _, p, G, h = problems(50, 5, 2, "generic", 1)
    gradients = []
    for fixed_sizes in (False, True):
        inputs = [x.clone().requires_grad_() for x in (p, G, h)]
        value = project_halfspaces_ball(-inputs[0], *inputs[1:], 2.0, fixed_sizes=fixed_sizes).value
        gradients.append(torch.autograd.grad((value * torch.arange(1.0, 3.0)).sum(), inputs))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


# ---- the world --------------------------------------------------------------------------------------------------------
def test_slots_are_reassigned_alike():
    changed = 0
    for index in range(0, COUNT, 2):
        env, (_, position, energy, slot) = edge(index, batch=64)
        given = (position, energy.clamp_min(0.9 * env.config.energy_max), slot, env.slots, env.geometry, env.bounds)
        chosen, fixed = (reassign_slots(*given, fixed_sizes=f) for f in (False, True))
        assert torch.equal(chosen, fixed)
        changed += int((chosen != slot).sum())
    assert changed > 50


def test_places():
    mask = torch.tensor([[True, False], [False, True], [False, False]])
    assert [x.tolist() for x in places(mask, fixed_sizes=False)] == [[0, 1], [0, 1]]
    assert [x.tolist() for x in places(mask, fixed_sizes=True)] == [[0, 0, 1, 1, 2, 2], [0, 1, 0, 1, 0, 1]]
    assert places(mask[:, :0], fixed_sizes=True)[0].tolist() == []


@pytest.mark.parametrize("fixed_sizes", [False, True])
def test_episodes_end_when_they_do_although_nobody_asks_before(fixed_sizes):
    """Worlds of different ages, a restored state and a state set by hand, against TorchRL's own question at every step."""
    world = SurveillanceConfig(horizon=7, on_violation="continue", resolution=3)
    envs = [SurveillanceEnv(world, 6, seed=4, fixed_sizes=fixed_sizes) for _ in range(2)]
    ask = type(envs[0]).__bases__[0].any_done
    envs[1].any_done = lambda td: ask(envs[1], td)
    ages = torch.arange(6).unsqueeze(-1)
    outs = []
    for env in envs:
        td = env.reset()
        state = env.state_dict()
        steps = []
        for k in range(30):
            if k == 3:  # of worlds that are older than the environment was told
                older = copy.deepcopy(state)
                older["state"]["step"] = ages
                env.load_state_dict(older)
            if k == 17:
                env.set_state(env.state["position"], env.state["energy"].unsqueeze(-1))
            td[keys.ACTION] = torch.zeros(6, world.n_agents, 2)
            done, td = env.step_and_maybe_reset(td)
            steps.append(torch.cat([done["next", "done"], env.state["step"]], dim=-1))
        outs.append(torch.stack(steps))
    assert torch.equal(*outs)
    assert outs[0][..., 0].sum() > 15


def test_the_device_is_asked_once_an_episode():
    world = SurveillanceConfig(horizon=10, on_violation="continue", resolution=3)
    env = SurveillanceEnv(world, 4, fixed_sizes=True)
    td, counts = env.reset(), []
    for _ in range(20):
        td[keys.ACTION] = torch.zeros(4, 3, 2)
        with Waits() as waits:
            _, td = env.step_and_maybe_reset(td)
        counts.append(sum(waits.found.values()) > 0)
    assert counts == [k in (0, 9, 10, 19) for k in range(20)]  # the first step and the last of an episode


def test_a_robot_outside_the_set_does_not_send_its_healthy_neighbours_home():
    world = SurveillanceConfig(on_violation="continue", horizon=0)
    shares = []
    for fixed_sizes in (False, True):
        env = SurveillanceEnv(world, 16, seed=1, fixed_sizes=fixed_sizes)
        f = SafetyFilter(SafetyConfig(), world, fixed_sizes=fixed_sizes)
        energy = env.state["energy"].clone()
        energy[:, 0] = 0.5 * world.energy_min
        td = env.set_state(env.state["position"], energy.unsqueeze(-1))
        generator, levels = torch.Generator().manual_seed(0), []
        for _ in range(40):
            noise = torch.randn(td[keys.POSITION].shape, generator=generator)
            td = env.step(f(td.set(keys.NOMINAL_ACTION, world.max_speed * noise)))
            levels.append(td[keys.LEVEL])
            td = td["next"]
        shares.append((torch.stack(levels)[..., 1:] == 0).double().mean())
        assert (torch.stack(levels)[..., 0] == HOMING).double().mean() > 0.8  # until it has charged
    assert min(shares) > 0.95


# ---- the switch -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("fields", [{"mode": "paper", "split": "joint"}, {"solver": "qpth"}])
def test_solvers_that_iterate_are_refused(fields):
    with pytest.raises(ValueError, match=r"fixed_sizes=true needs the exact solver.*safety\.solver.*fixed_sizes=false"):
        SafetyFilter(SafetyConfig(**fields), SurveillanceConfig(), fixed_sizes=True)
    overrides = [f"safety.{name}={value}" for name, value in fields.items()]
    with pytest.raises(ValueError, match="fixed_sizes=true needs"):
        to_config(composed("fixed_sizes=true", *overrides))
    to_config(composed(*overrides))


def test_an_evaluation_that_cannot_be_is_refused_before_it_writes(program, tmp_path):
    small = ("num_envs=2", "steps=3", "pictures=false", "device=cpu")
    code, output = program(evaluate.main, "controller=gather", "fixed_sizes=true", "safety.solver=qpth", *small)
    assert code == 1
    assert output.startswith("error: fixed_sizes=true needs the exact solver")
    assert not list(tmp_path.rglob("*.json"))


def test_evaluations_of_a_run_at_fixed_sizes_have_a_folder_of_their_own(program, tmp_path):
    small = ("collector.num_envs=4", "collector.total_frames=40", "train.warmup_frames=4", "buffer.batch_size=4")
    quick = ("eval.num_envs=2", "eval.steps=2", "log.figures=false", "log.gif=false", "device=cpu", "agent.n_steps=1")
    assert program(train.main, *small, *quick, "fixed_sizes=true")[0] == 0
    (summary,) = tmp_path.glob("runs/*/*/summary.json")
    asked = (f"run={summary.parent}", "num_envs=2", "steps=3", "pictures=false", "device=cpu", "resume=auto")
    for more in ((), ("fixed_sizes=true",), ("safety.solver=qpth",)):
        code, output = program(evaluate.main, *asked, *more)
        assert code == 0, output
    found = [json.loads(path.read_text())["fixed_sizes"] for path in summary.parent.glob("eval/*/eval.json")]
    assert sorted(found) == [False, False, True]


def test_runs_keep_their_names():
    assert config_hash(composed("fixed_sizes=false")) == config_hash(composed())
    assert config_hash(composed("fixed_sizes=true")) != config_hash(composed())
