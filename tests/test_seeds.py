"""Several seeds in one program: each run is, file by file and bit by bit, the run of a program of its own."""

import json
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import train
from agents.checkpoint import CheckpointError, checkpoints, load_checkpoint, save_checkpoint
from agents.config import AgentConfig
from agents.incident import ViolationError
from agents.learners import LearnerStack, make_learner, make_learners
from agents.maddpg import clip_gradients, update_step
from agents.networks import make_policies
from agents.pipeline import InferenceCollector
from agents.report_runs import find_runs
from agents.run import TrainingRun
from agents.seeds import SeedsFailedError, equally_far, for_each, stopped_at
from conf.naming import config_hash
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.coverage import weighted_sum
from safety import SafetyConfig
from tests.killing import RUN, differences, result, run

CPU = torch.device("cpu")
QUIET = (*RUN, "log.gif=false", "log.figures=false", "collector.total_frames=512")
SHORT = (*QUIET, "collector.total_frames=384")
VARIANTS = {
    "networks of their own, minibatches of their own, clipped": (
        *("agent.share_params=false", "agent.minibatch=per_agent", "agent.max_grad_norm=0.05", "env=default"),
    ),
    "one world to evaluate in": ("eval.num_envs=1",),
    "filter in the loss": ("safety.in_loss=true", "agent.correction_penalty=0.1", "env.n_agents=2"),
    "violations, one update a step": (
        *("safety=none", "env.on_violation=continue", "train.violation_penalty=1", "collector.steps_per_batch=1"),
    ),
}


def compared(folder: Path) -> dict:
    """What a run must share with the same seed's run in a program of its own."""
    content = result(folder)
    content["summary"].pop("n_seeds", None)
    content["checkpoint"].pop("torch")  # the global stream, which nothing draws from after the start
    return content


def said(folder: Path) -> str:
    return " ".join(Path(f"{folder}.log").read_text().split())


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Results of seeds 0 and 1 in programs of their own."""
    folder = tmp_path_factory.mktemp("alone")
    for seed in (0, 1):
        assert run(folder / f"seed{seed}", (*QUIET, f"seed={seed}")) == 0, said(folder / f"seed{seed}")
    return [compared(folder / f"seed{seed}") for seed in (0, 1)]


@pytest.mark.parametrize(
    ("stage", "count"),
    [(None, 1), ("before rename", 15), ("after checkpoint", 1), ("after checkpoint", 9), ("in summary", 2)],
)
def test_each_seed_is_the_run_that_it_would_be_alone(tmp_path, alone, stage, count):
    # also where the program is killed between the seeds' checkpoints, before all have one, and between their summaries
    folder, arguments = tmp_path / "program", (*QUIET, "n_seeds=2")
    if stage is not None:
        assert run(folder, arguments, stage=stage, count=count) == -signal.SIGKILL, said(folder)
    assert run(folder, arguments) == 0, said(folder)
    assert not differences(alone, [compared(folder / f"seed{seed}") for seed in (0, 1)])


@pytest.mark.parametrize("overrides", VARIANTS.values(), ids=VARIANTS)
def test_each_seed_is_the_run_that_it_would_be_alone_in_other_settings(tmp_path, overrides):
    arguments = (*SHORT, *overrides)
    assert run(tmp_path / "alone", (*arguments, "seed=7")) == 0, said(tmp_path / "alone")
    assert run(tmp_path / "program", (*arguments, "seeds=[3,7,5]")) == 0, said(tmp_path / "program")
    assert not differences(compared(tmp_path / "alone"), compared(tmp_path / "program" / "seed7"))


def test_a_stopped_program_goes_on_as_single_runs(tmp_path, alone):
    folder = tmp_path / "program"
    assert run(folder, (*QUIET, "n_seeds=2"), stage="after checkpoint", count=8) == -signal.SIGKILL, said(folder)
    newest = [checkpoints(folder / f"seed{seed}" / "checkpoints")[-1].name for seed in (0, 1)]
    assert run(folder / "seed1", (*QUIET, "seed=1")) == 0, said(folder / "seed1")
    assert f"going on from {folder}/seed1/checkpoints/{newest[1]}" in said(folder / "seed1")
    assert not differences(alone[1], compared(folder / "seed1"))


def test_finished_seeds_are_left_alone_and_a_failed_one_does_not_end_the_others(program, tmp_path, monkeypatch, alone):
    runs = tmp_path / "runs" / "smoke"
    assert program(train.main, *QUIET)[0] == 0
    (first,) = runs.glob("*_seed0")
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}

    bad = []

    def init(self, *arguments, real=TrainingRun.__init__, **options):
        real(self, *arguments, **options)
        if self.seed == 2:
            bad.append(self)

    def rollout(self, real=InferenceCollector.rollout):
        batch = real(self)
        for own in bad:
            if own.worlds.env is self.env and own.recorder.frames >= 128:
                with torch.inference_mode():  # as it was collected
                    batch["next"][keys.REWARD][own.worlds.worlds].fill_(torch.nan)
        return batch

    def break_seed_2():
        monkeypatch.setattr(TrainingRun, "__init__", init)
        monkeypatch.setattr(InferenceCollector, "rollout", rollout)

    break_seed_2()
    code, output = program(train.main, *QUIET, "n_seeds=4")
    assert code == 1
    error = output[output.index("error:") :].splitlines()
    assert len(error) <= 8
    assert "1 of 4 seeds failed: 2." in error[0]
    assert "seed 2: training diverged at frame 160: rewards not finite" in " ".join(output.split())
    assert before == {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    finished = {path.parent.name[-1] for path in runs.glob("*_seed?/summary.json")}
    assert finished == {"0", "1", "3"}
    (failed,) = runs.glob(
        "*_seed2"
    )  # the replay holds what was not a number by then, and the networks have learned from it
    kept = [
        load_checkpoint(path) for path in [*checkpoints(failed / "checkpoints"), failed / "checkpoints" / "best.pt"]
    ]
    assert max(content["frames"] for content in kept) <= 128
    assert [path.name for path in runs.glob("*_seeds*")] == [f"{first.name.split('_')[0]}_seeds0-3"]
    assert not differences(alone[1], compared(next(runs.glob("*_seed1"))))

    break_seed_2()
    code, output = program(train.main, *QUIET, "seeds=[4,2]")  # the others do not wait for it
    assert code == 1
    assert "1 of 2 seeds failed: 2." in output
    assert list(runs.glob("*_seed4/summary.json"))
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    code, output = program(train.main, *QUIET, "n_seeds=4")  # the failed one goes on
    assert code == 0, output
    assert "going on from" in output
    code, output = program(train.main, *QUIET, "seeds=[2,0]")
    assert code == 0
    assert output.count("nothing to do") == 2
    found = find_runs(runs, config_hash)
    assert [(run.seed, run.method, run.finished) for run in found] == [(k, found[0].method, True) for k in range(5)]
    tags = EventAccumulator(str(found[2].folder)).Reload().Tags()["scalars"]
    assert "eval/coverage_cost" in tags
    assert json.loads((found[2].folder / "summary.json").read_text())["seed"] == 2


def test_a_violation_in_an_evaluation_ends_its_seed_alone(program, tmp_path, monkeypatch, alone):
    def check(td, alive=None, *, world, safety, folder):
        assert td.shape == (len(alive),) == (2,)  # its own block
        if folder.name.endswith("_seed1"):
            raise ViolationError("a robot ran empty")

    monkeypatch.setattr("agents.run.check_violations", check)
    monkeypatch.setattr("agents.seeds.broken_promises", lambda td, alive: alive)
    code, output = program(train.main, *QUIET, "n_seeds=3")
    assert code == 1
    assert "1 of 3 seeds failed: 1." in output
    assert "seed 1: a robot ran empty" in output
    runs = tmp_path / "runs" / "smoke"
    assert {path.parent.name[-1] for path in runs.glob("*_seed?/summary.json")} == {"0", "2"}
    assert not differences(alone[0], compared(next(runs.glob("*_seed0"))))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("seeds=[1,2,1]",), "seeds=[1,2,1] names 1 more than once"),
        (("seeds=[]",), "the number of seeds=0 is out of range"),
        (("seeds=[0,-3]",), "seeds=-3 is out of range"),
        (("n_seeds=0",), "n_seeds=0 is out of range: allowed [1, 1000]"),
        (("n_seeds=2", "seeds=[0,1]"), "exclude each other"),
        (("n_seeds=2", "resume=."), "resume=. is one run's checkpoint, and several seeds are asked for"),
    ],
)
def test_bad_seeds(program, tmp_path, overrides, message):
    code, output = program(train.main, *SHORT, *overrides)
    assert code == 1
    assert message in " ".join(output.split())
    assert len(output.splitlines()) <= 8
    assert not (tmp_path / "runs").exists()


def test_seeds_that_have_come_differently_far_are_trained_in_turn(tmp_path, alone):
    folder = tmp_path / "program"
    folder.mkdir()
    code = run(folder / "seed1", (*QUIET, "seed=1"), stage="after checkpoint", count=5)
    assert code == -signal.SIGKILL, said(folder / "seed1")
    assert run(folder, (*QUIET, "n_seeds=2")) == 0, said(folder)
    assert f"going on from {folder}/seed1/checkpoints/frames_000000000480.pt" in said(folder)
    assert not differences(alone, [compared(folder / f"seed{seed}") for seed in (0, 1)])


def test_a_signal_writes_the_checkpoints_of_all_seeds(tmp_path, alone):
    folder, arguments = tmp_path / "program", (*QUIET, "n_seeds=2", "checkpoint.interval_frames=0")
    assert run(folder, arguments, stage="in training", count=5, by=signal.SIGTERM) == 128 + signal.SIGTERM, said(folder)
    newest = {checkpoints(folder / f"seed{seed}" / "checkpoints")[-1].name for seed in (0, 1)}
    assert len(newest) == 1
    frames = int(newest.pop()[7:-3])
    assert 0 < frames < 512
    assert f"stopped by SIGTERM at {frames} frames, checkpoint written in the folders of 2 seeds" in said(folder)
    assert run(folder, arguments) == 0, said(folder)
    assert not differences([own["curves"] for own in alone], [compared(folder / f"seed{k}")["curves"] for k in (0, 1)])


def test_a_program_ends_as_soon_as_all_its_seeds_have_failed():
    closed, acted = [], []
    board = SimpleNamespace(close=lambda: closed.append(1))
    runs = [SimpleNamespace(seed=seed, error=None, board=board) for seed in (4, 7)]

    def act(run, limit):
        acted.append(run.seed)
        if run.seed < limit:
            raise CheckpointError(f"{run.seed} is broken")

    for_each(runs, act, [5, 5])
    assert (str(runs[0].error), runs[1].error, len(closed)) == ("4 is broken", None, 1)
    for_each(runs, act, [5, 5])
    assert acted == [4, 7, 7]
    with pytest.raises(SeedsFailedError, match=r"^2 of 2 seeds failed: 4, 7\.\nseed 4: 4 is broken$"):
        for_each(runs, act, [9, 9])
    with pytest.raises(CheckpointError, match="7 is broken"):  # alone it is the program's error
        for_each([SimpleNamespace(seed=7, error=None, board=board)], act, [9])


def test_a_stopped_program_says_where_its_checkpoints_are_and_what_had_failed():
    good = [
        SimpleNamespace(seed=k, error=None, folder=f"runs/{k}", recorder=SimpleNamespace(frames=96)) for k in (3, 5)
    ]
    bad = SimpleNamespace(seed=4, error=CheckpointError("broken"))
    assert stopped_at(good[:1]) == "at 96 frames, checkpoint written in runs/3"
    assert stopped_at(good) == "at 96 frames, checkpoint written in the folders of 2 seeds"
    assert stopped_at([bad, *good[1:]]) == "at 96 frames, checkpoint written in runs/5; seed 4 had failed: broken"


def test_groups_of_seeds(tmp_path):
    def save(seed, *frames, updates=0):
        for count in frames:
            moments = {0: {"step": torch.tensor(float(count + updates))}}
            parts = {"optimizers": {"loss_value": {"state": moments}}}
            path = tmp_path / str(seed) / "checkpoints" / f"frames_{count:012d}.pt"
            save_checkpoint(path, {"frames": count, "parts": parts, "replay": None, "ended": False})

    def groups(*seeds):
        found = equally_far({seed: tmp_path / str(seed) for seed in seeds}, "auto", [].append, rows=True)
        return [(start, sorted(group)) for start, group in found]

    save(0, 100, 200)
    save(1, 100)
    save(2, 200, updates=1)  # the same frames, another history
    save(3, 100, 200, 300)
    assert groups(0, 1, 3) == [(100, [0, 1, 3])]
    assert groups(0, 3) == [(200, [0, 3])]
    assert groups(0, 2) == [(200, [2]), (200, [0])]
    assert groups(4, 5, 0) == [(0, [4, 5]), (200, [0])]
    (tmp_path / "1" / "checkpoints" / "frames_000000000100.pt").write_bytes(b"damaged")
    assert groups(0, 1) == [(200, [0]), (0, [1])]
    assert equally_far({0: tmp_path, 1: tmp_path}, "never", [].append, rows=True) == [(0, {0: tmp_path, 1: tmp_path})]


def test_seeds_go_on_from_checkpoints_that_have_their_rows(tmp_path):
    for seed in (0, 1):
        folder = tmp_path / str(seed) / "checkpoints"
        for first, frames in ((0, 100), (100, 200)):
            content = {"frames": frames, "parts": {"optimizers": {"loss_value": {"state": {}}}}, "ended": False}
            save_checkpoint(folder / f"frames_{frames:012d}.pt", content | {"replay": {"written": frames, "first": 0}})
            save_checkpoint(folder / "replay" / f"rows_{first:015d}_{frames:015d}.pt", {"rows": {}})
    folders: dict[int, Path] = {seed: tmp_path / str(seed) for seed in (0, 1)}
    said: list[str] = []
    assert equally_far(folders, "auto", said.append, rows=True) == [(200, folders)]
    (tmp_path / "1" / "checkpoints" / "replay" / f"rows_{100:015d}_{200:015d}.pt").write_bytes(b"damaged")
    assert equally_far(folders, "auto", said.append, rows=True) == [(100, folders)]
    assert "passed over frames_000000000200.pt" in said[0]
    assert equally_far(folders, "auto", said.append, rows=False) == [(200, folders)]
    (tmp_path / "1" / "checkpoints" / "replay" / f"rows_{0:015d}_{100:015d}.pt").unlink()
    # it has none that is whole: its newest says what is missing
    assert equally_far(folders, "auto", said.append, rows=True) == [(200, folders)]


def test_blocks_of_worlds_are_worlds_of_their_own():
    config = SurveillanceConfig(horizon=4, density="gaussian_mixture", density_per_world=True)
    together = SurveillanceEnv(config, 6, seed=[5, 9])
    apart = [SurveillanceEnv(config, 3, seed=seed) for seed in (5, 9)]

    def roll(steps):
        for _ in range(steps):
            nonlocal td, tds
            for td_ in (td, *tds):
                td_[keys.ACTION] = 0.05 * td_[keys.POSITION]
            (_, td), *rest = (
                env.step_and_maybe_reset(t) for env, t in zip((together, *apart), (td, *tds), strict=True)
            )
            tds = [t for _, t in rest]

    td, tds = together.reset(), [env.reset() for env in apart]
    roll(6)  # over the end of the episodes
    assert (td == torch.cat(tds)).all()
    saved = [block.state_dict() for block in together.blocks]
    assert not differences(saved, [env.state_dict() for env in apart])
    for env, state in zip(apart, reversed(saved), strict=True):
        env.continue_from(state)
    together.blocks[0].continue_from(saved[1])
    together.blocks[1].continue_from(saved[0])
    td, tds = together.reset(), [env.reset() for env in apart]
    assert (td == torch.cat(tds)).all()
    roll(5)
    assert (td == torch.cat(tds)).all()
    with pytest.raises(ValueError, match="several seeds"):
        together.state_dict()
    with pytest.raises(ValueError, match="num_envs=5 is not a multiple of the number of seeds, 2"):
        SurveillanceEnv(config, 5, seed=[5, 9])


def test_a_stack_shares_memory_with_its_learners():
    world, agent = SurveillanceConfig(), AgentConfig(actor_cells=[5], critic_cells=[6])
    arguments = (SurveillanceEnv(world, 1).n_observation, world, agent, SafetyConfig(), CPU)
    parts, stack = make_learners(*arguments, seeds=[3, 4])
    assert isinstance(stack, LearnerStack)
    for part, seed in zip(parts, (3, 4), strict=True):
        twin = make_learner(*arguments, seed=seed)
        assert not differences(dict(part.loss.state_dict()), dict(twin.loss.state_dict()))
    env = SurveillanceEnv(world, 4, seed=[0, 1])
    _, explore = make_policies(stack.actor, world, SafetyConfig(), agent, [0, 1], CPU)
    with torch.no_grad():
        batch = env.rollout(3, explore).reshape(2, -1)
    before = [{name: value.clone() for name, value in part.actor.state_dict().items()} for part in parts]
    update_step(batch, *stack.updates, agent)
    for part, old in zip(parts, before, strict=True):
        assert all(not torch.equal(value, old[name]) for name, value in part.actor.state_dict().items())
    stack.share_moments()
    for name in stack.optimizers:
        first, second = (list(part.optimizers[name].state.values()) for part in parts)
        assert all(not torch.equal(a["exp_avg"], b["exp_avg"]) for a, b in zip(first, second, strict=True))

    # into a new stack, through the parts' checkpoints
    copies, copy = make_learners(*arguments, seeds=[8, 9])
    for target, source in zip(copies, parts, strict=True):
        target.loss.load_state_dict(source.loss.state_dict())
        for name, optimizer in target.optimizers.items():
            optimizer.load_state_dict(source.optimizers[name].state_dict())
    copy.gather_moments()
    for one in (stack, copy):
        update_step(batch, *one.updates, agent)
    assert not differences(dict(copy.loss.state_dict()), dict(stack.loss.state_dict()))


def test_gradients_are_clipped_learner_by_learner():
    weights = [torch.randn(4, 3, 2, requires_grad=True), torch.randn(2, 5, requires_grad=True)]
    for weight, size in zip(weights, (3.0, 0.01), strict=True):
        weight.grad = size * torch.randn_like(weight)
    weights[0].grad[2:] *= 1e-3
    alone = [
        [torch.nn.Parameter(w[k * len(w) // 2 : (k + 1) * len(w) // 2].detach()) for w in weights] for k in range(2)
    ]
    for k, own in enumerate(alone):
        for part, w in zip(own, weights, strict=True):
            part.grad = w.grad[k * len(w) // 2 : (k + 1) * len(w) // 2].clone()
    norms = [torch.nn.utils.clip_grad_norm_(own, 0.5) for own in alone]
    assert torch.equal(clip_gradients(weights, 0.5, 2), torch.stack(norms))
    for j, weight in enumerate(weights):
        assert torch.equal(weight.grad, torch.cat([own[j].grad for own in alone]))
    assert norms[0] > 0.5 > norms[1]  # only the first one is cut


def test_sums_over_points_do_not_depend_on_the_other_batches():
    values, weights = torch.rand(3, 50, 100), torch.rand(100)
    assert torch.equal(weighted_sum(values, weights), torch.stack([own @ weights for own in values]))


def test_a_checkpoint_of_several_seeds_is_one_of_a_single_run(tmp_path):
    folder = tmp_path / "program"
    assert run(folder, (*SHORT, "n_seeds=2")) == 0, said(folder)
    content = load_checkpoint(checkpoints(folder / "seed1" / "checkpoints")[-1])
    assert content["seed"] == 1
    assert content["parts"]["env"]["state"]["position"].shape[0] == 8
    assert content["parts"]["optimizers"]["loss_actor"]["state"][0]["exp_avg"].dim() == 2
