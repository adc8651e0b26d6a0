import json
import math
from pathlib import Path

import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import evaluate
import train
from agents.incident import load_incident
from envs import SurveillanceConfig, graphs
from envs.inequalities import derived_quantities
from tests.standin_recording import StandInRecording

TINY = (
    *("collector.num_envs=4", "collector.steps_per_batch=2", "collector.total_frames=64", "buffer.batch_size=8"),
    *("buffer.capacity=64", "train.warmup_frames=16", "train.n_updates=1", "eval.num_envs=2", "eval.steps=5"),
    *("eval.interval_frames=32", "checkpoint.interval_episodes=1", "env.horizon=6", "device=cpu"),
    *("log.figures=false", "log.gif=false"),
)
PICTURES = ("log.figures=true", "log.gif=true", "eval.interval_frames=0")  # where the world decides how they look
VARIANTS = {
    **{experiment: (f"experiment={experiment}",) for experiment in ("default", "smoke", "paper", "paper_literal")},
    "literal filter": ("safety=paper",),
    "stacked filter": ("safety=stacked",),
    "unfiltered": ("safety=none",),
    "learned layer": ("safety=dalal", "safety.dalal_steps=20"),
    "learned layer in the loss": ("safety=dalal", "safety.dalal_steps=20", "safety.in_loss=true"),
    "joint filter": ("safety=joint",),
    "filter in the loss": ("safety.in_loss=true", "agent.correction_penalty=0.1"),
    "joint filter in the loss": ("safety=joint", "safety.in_loss=true"),
    "qpth per robot": ("safety.solver=qpth",),
    "independent learners": ("agent=ddpg",),
    "shared gradient": ("agent.gradient=shared", "agent.share_params=true"),
    "own minibatches, OU noise": ("agent.minibatch=per_agent", "agent.noise=ou"),
    "violation penalty": ("safety=none", "train.violation_penalty=1.0", "env.on_violation=continue"),
    "adversary": ("experiment=adversary",),
    "adversary of one robot behind the literal filter": ("train.objective=adversary", "safety=paper", "env.n_agents=1"),
    "aerial": ("env=aerial", *PICTURES),
    "five robots, float64": ("env=five_robots", "env.dtype=float64", *PICTURES),
    "density per world": ("env=random_density",),
    "moving density": ("env=moving_density", *PICTURES),
    "age density": ("env=age_density", *PICTURES),
    "long duration": ("env=long_duration", "env.horizon=0", *PICTURES),
    "one robot": ("env.n_agents=1", *PICTURES),
}


def only_run(tmp_path) -> Path:
    (summary,) = tmp_path.glob("runs/*/*/summary.json")
    return summary.parent


@pytest.mark.parametrize("overrides", VARIANTS.values(), ids=VARIANTS.keys())
def test_tiny_run(program, tmp_path, overrides):
    code, output = program(train.main, *TINY, *overrides)
    assert code == 0, output
    folder = only_run(tmp_path)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] == 64
    assert set(summary["train"]["violations"]) == {"depleted", "stranded", "overcharged", "collision"}
    filter_keys = {"intervention_rate", "mean_correction", "fallback_rate", "infeasible", "outside", "max_residual"}
    assert filter_keys <= set(summary["filter"])
    eval_keys = {
        "coverage_cost",
        "episode_reward",
        "violations",
        "charges_per_robot",
        "min_energy_margin",
        "min_distance_margin",
    }
    assert eval_keys <= set(summary["eval"])
    top = {"config_hash", "git_hash", "versions", "seed", "frames", "episodes", "wall_time_s", "frames_per_second"}
    assert top <= set(summary)
    assert math.isfinite(summary["eval"]["coverage_cost"])
    assert folder.name == f"{summary['config_hash']}_seed0"


def test_run_folder_tensorboard_and_evaluation(program, tmp_path):
    code, output = program(train.main, "experiment=smoke", "seed=3")
    assert code == 0, output
    folder = only_run(tmp_path)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["seed"] == 3
    assert summary["episodes"] >= 8
    events = EventAccumulator(str(folder)).Reload()
    tags = set(events.Tags()["scalars"])
    assert {tag.split("/")[0] for tag in tags} == {"train", "loss", "filter", "eval", "time"}
    assert {"train/return", "train/coverage_cost", "train/violations_collision", "loss/actor", "loss/value"} <= tags
    assert events.Scalars("train/coverage_cost")[-1].step == summary["frames"]  # the x-axis is frames
    with Image.open(folder / "figures" / "training.png") as picture:
        assert picture.size[0] > 400
    assert len(list((folder / "checkpoints").glob("*.pt"))) >= 2
    assert not list((folder / "checkpoints").glob("*.tmp"))

    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    code, output = program(train.main, "experiment=smoke", "seed=3")
    assert code == 0
    assert "finished run" in output
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before

    code, output = program(evaluate.main, f"run={folder}", "steps=30", "num_envs=3")
    assert code == 0, output
    target = folder / "eval" / "default_30_0"
    result = json.loads((target / "eval.json").read_text())
    assert result["robot_steps"] == 3 * 3 * 30
    assert "intervention_rate" in result["filter"]
    for name in ("surveying_1.png", "charging.png", "surveying_2.png", "battery.png", "paths.png", "world.gif"):
        with Image.open(target / name) as picture:
            assert picture.size[0] > 300

    first = sorted((folder / "checkpoints").glob("*.pt"))[0].name
    arguments = (f"run={folder}", "steps=30", "num_envs=3", "pictures=false")
    code, output = program(evaluate.main, *arguments, f"checkpoint={first}", "safety=none")
    assert code == 0, output
    (other,) = folder.glob("eval/default_none_30_0_*/eval.json")  # the run's own evaluation is not overwritten
    assert json.loads(other.read_text())["policy"].endswith(first)
    assert json.loads(other.read_text())["safety"]["mode"] == "none"
    assert json.loads((target / "eval.json").read_text()) == result
    former = other.parent.rename(
        other.parent.with_name(other.parent.name.replace("none_", ""))
    )  # before it had the name
    code, output = program(evaluate.main, *arguments, f"checkpoint={first}", "safety=none", "resume=auto")
    assert f"{former}/eval.json exists: nothing to do" in output
    code, output = program(evaluate.main, f"run={folder}", "checkpoint=missing.pt")
    assert code == 1
    assert "missing.pt does not exist" in " ".join(output.split())
    code, output = program(evaluate.main, f"run={folder}/checkpoints/{first}")
    assert code == 1
    assert f"run= takes the folder itself: use run={folder} checkpoint={first}." in " ".join(output.split())

    files = set(folder.rglob("*"))
    code, output = program(evaluate.main, f"run={folder}", "env.n_agents=5")
    assert code == 1
    text = " ".join(output.split())
    assert (
        "n_agents is 3 there, 5 here; n_observation is 18 there, 28 here (stations 6 there, 10 here; others 4 there, 8 here; "
        in text
    )
    assert "A policy fits worlds with the same observation" in text
    assert "Traceback" not in output
    assert set(folder.rglob("*")) == files


def test_same_seed_same_result(program, tmp_path):
    results = []
    short = ("experiment=smoke", "collector.total_frames=256", "log.figures=false", "log.gif=false")
    for name in ("a", "b"):
        code, output = program(train.main, *short, f"hydra.run.dir={name}")
        assert code == 0, output
        summary = json.loads((tmp_path / name / "summary.json").read_text())
        results.append((summary["eval"], summary["filter"], summary["train"]))
    assert results[0] == results[1]
    again = (*short, "hydra.run.dir=a", "resume=never")
    code, _ = program(train.main, *again)
    assert json.loads((tmp_path / "a" / "summary.json").read_text())["eval"] == results[0][0]
    assert (tmp_path / "a" / "replaced_1" / "summary.json").exists()
    code, _ = program(train.main, *short, "hydra.run.dir=c", "seed=1")
    other = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert other["eval"] != results[0][0]


def test_controller_evaluation_writes_its_own_folder(program, tmp_path):
    code, output = program(evaluate.main, "controller=lloyd", "steps=10", "num_envs=2", "pictures=false")
    assert code == 0, output
    (result,) = tmp_path.glob("runs/controllers/lloyd_certified_default_10_0_*/eval.json")
    assert json.loads(result.read_text())["robot_steps"] == 60


def test_vector_graphics_are_written_without_a_word_of_their_fonts(program, tmp_path):
    code, output = program(evaluate.main, "controller=lloyd", "steps=3", "num_envs=1", "format=pdf", "video=none")
    assert code == 0, output
    assert len(list(tmp_path.glob("runs/controllers/*/*.pdf"))) == 5
    assert "pruned" not in output


def test_a_sweep_of_controllers_writes_under_runs_only(program, tmp_path):
    code, output = program(evaluate.main, "-m", "controller=random,lloyd", "steps=3", "num_envs=2", "pictures=false")
    assert code == 0, output
    assert len(list(tmp_path.glob("runs/controllers/*/eval.json"))) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_killed_sweep_of_controllers_goes_on(program, tmp_path):
    sweep = ("-m", "controller=random,lloyd", "steps=3", "num_envs=2", "pictures=false", "resume=auto")
    program(evaluate.main, *sweep)
    first, second = sorted(tmp_path.glob("runs/controllers/*/eval.json"))
    second.unlink()
    stamp = first.stat().st_mtime_ns
    code, output = program(evaluate.main, *sweep)
    assert code == 0, output
    assert second.is_file()
    assert first.stat().st_mtime_ns == stamp
    assert "nothing to do" in output


def test_another_evaluation_in_the_same_folder_is_not_taken_for_this_one(program, tmp_path):
    code, output = program(train.main, *TINY)
    assert code == 0, output
    (run,) = tmp_path.glob("runs/default/*_seed0")
    common = (f"run={run}", "steps=4", "pictures=false", "resume=auto")
    for num_envs in (2, 3):
        code, output = program(evaluate.main, *common, f"num_envs={num_envs}")
        assert code == 0, output
        assert "nothing to do" not in output
    assert "nothing to do" in program(evaluate.main, *common, "num_envs=3")[1]


def test_a_policy_that_has_been_trained_further_is_evaluated_again(program, tmp_path):
    assert program(train.main, *TINY)[0] == 0
    (run,) = tmp_path.glob("runs/default/*_seed0")
    common = (f"run={run}", "steps=4", "num_envs=2", "pictures=false", "resume=auto", "checkpoint=best.pt")
    assert program(evaluate.main, *common)[0] == 0
    (path,) = run.glob("eval/*/eval.json")
    first, best = json.loads(path.read_text()), run / "checkpoints" / "best.pt"
    assert "nothing to do" in program(evaluate.main, *common)[1]
    path.write_text(json.dumps(first | {"git_hash": "0123abc"}))
    assert "It was made by the code of 0123abc, this is " in " ".join(program(evaluate.main, *common)[1].split())
    torch.save(torch.load(best, weights_only=True) | {"frames": first["policy_frames"] + 1}, best)
    code, output = program(evaluate.main, *common)
    assert code == 0, output
    assert "nothing to do" not in output
    assert json.loads(path.read_text())["policy_frames"] == first["policy_frames"] + 1


def test_a_finished_run_of_other_code_is_left_alone_and_says_so(program, tmp_path):
    assert program(train.main, *TINY, "hydra.run.dir=run")[0] == 0
    path = tmp_path / "run" / "summary.json"
    assert "the code of" not in program(train.main, *TINY, "hydra.run.dir=run")[1]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"git_hash": "0123abc"}))
    output = " ".join(program(train.main, *TINY, "hydra.run.dir=run")[1].split())
    assert "holds a finished run: nothing to do. It was trained by the code of 0123abc, this is " in output


def test_a_run_that_learns_nothing_says_so(program, tmp_path):
    updates = {}
    for warmup in (0, 32, 64, 65):
        code, output = program(train.main, *TINY, f"train.warmup_frames={warmup}", f"hydra.run.dir={warmup}")
        assert code == 0, output
        said = "nothing is learnt: train.warmup_frames=65 is more than collector.total_frames=64." in output
        assert said == (warmup == 65)
        updates[warmup] = json.loads((tmp_path / str(warmup) / "summary.json").read_text())["updates"]
    assert updates == {0: 6, 32: 5, 64: 1, 65: 0}  # 8 iterations; the first transition of 5 steps comes in the third


def test_overrides_of_an_evaluation_are_checked_in_the_runs_world(program, tmp_path):
    """0.01 is below the default world's drain, but not below the run's."""
    code, output = program(train.main, *TINY, "env.drain_rate=0.001", "env.charge_rate=0.02", "safety=paper")
    assert code == 0, output
    (run,) = tmp_path.glob("runs/default/*_seed0")
    common = (f"run={run}", "steps=4", "num_envs=2", "pictures=false")
    code, output = program(evaluate.main, *common, "env.charge_rate=0.01", "safety.alpha_s=2.0")
    assert code == 0, output
    code, output = program(evaluate.main, *common, "env.charge_rate=0.0005")
    assert code == 1
    assert "K_c > P(max_speed) fails" in output


def test_run_folder_holds_the_certificate(program, tmp_path):
    code, output = program(train.main, *TINY)
    assert code == 0, output
    (path,) = tmp_path.glob("runs/*/*/certificate.json")
    certificate = json.loads(path.read_text())
    assert certificate == pytest.approx(derived_quantities(SurveillanceConfig(horizon=6)))
    assert f"clearance {certificate['clearance']:.4g}" in output


def test_a_bad_job_of_a_multirun_leaves_the_others_alone(program, tmp_path):
    code, output = program(train.main, "-m", *TINY, "env.n_agents=2,0")
    assert code == 1
    assert "env.n_agents=0" in output
    assert len(list(tmp_path.glob("runs/*/*/summary.json"))) == 1


def test_an_evaluation_by_graphs_has_fixed_sizes(program, tmp_path, monkeypatch):
    monkeypatch.setattr(graphs, "recorder_for", lambda tensor: StandInRecording)
    short = ("controller=random", "env=five_robots", "steps=8", "num_envs=4", "pictures=false", "device=cpu")
    found = []
    for sizes in ("cuda_graphs=true", "fixed_sizes=true"):
        code, output = program(evaluate.main, *short, sizes, "resume=never")
        assert code == 0, output
        (path,) = tmp_path.glob("runs/**/eval.json")
        found.append(json.loads(path.read_text()))
        path.unlink()
    assert [content["fixed_sizes"] for content in found] == [True, True]
    assert found[0]["coverage_cost"] == found[1]["coverage_cost"]
    code, output = program(evaluate.main, *short, "cuda_graphs=true", "safety=half", "safety.split=joint")
    assert code == 1
    assert "fixed_sizes=false cuda_graphs=false" in " ".join(output.split())


@pytest.mark.parametrize("sizes", [(), ("cuda_graphs=true",)], ids=["", "graphs"])
def test_training_stops_at_a_broken_promise(program, tmp_path, monkeypatch, sizes):
    """A shield that lets everybody meet in the middle. Evaluations, which would find it first, are left out."""

    def broken(_, position, energy, home, action, current, level, *rest, **options):
        return -0.19 * position / position.norm(dim=-1, keepdim=True).clamp_min(0.1), level, None

    monkeypatch.setattr("safety.filter.shield", broken)
    monkeypatch.setattr(train, "evaluate", lambda *_: None)
    monkeypatch.setattr(graphs, "recorder_for", lambda tensor: StandInRecording)
    code, output = program(train.main, *TINY, *sizes, "collector.total_frames=4000")
    assert code == 1
    assert "behind the certified filter, which must not happen" in " ".join(output.split())
    (dump,) = tmp_path.glob("runs/**/violation.json")
    assert load_incident(dump).safety.mode == "certified"
