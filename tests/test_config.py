import dataclasses
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

import evaluate
import train
from agents import AgentConfig
from conf.schema import Config, config_hash, to_config

CONF = Path(__file__).parents[1] / "conf"
GROUPS = [
    (group, path.stem)
    for group in ("env", "safety", "agent", "train", "experiment", "method")
    for path in (CONF / group).glob("*.yaml")
    if path.stem != "tune"  # needs Optuna: test_launchers.py
]


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


@pytest.mark.parametrize(("group", "option"), GROUPS)
def test_every_yaml_composes_and_validates(group, option):
    config = to_config(composed(f"{group}={option}"))
    assert isinstance(config, Config)


def test_every_field_of_the_schema_can_be_set_from_the_command_line():
    def leaves(value, prefix):
        for field in dataclasses.fields(value):
            inner, name = getattr(value, field.name), f"{prefix}{field.name}"
            if dataclasses.is_dataclass(inner):
                yield from leaves(inner, name + ".")
            else:
                yield name, inner

    overrides = []
    for name, value in leaves(Config(), ""):
        text = "null" if value is None else str(value).replace(" ", "").replace("'", "")
        overrides.append(f"{name}={text}")
    assert to_config(composed(*overrides)) == Config()


def test_paper_run_is_the_papers_algorithm():
    agent = to_config(composed("experiment=paper")).agent
    assert (agent.critic_action, agent.n_steps, agent.noise, agent.gamma) == ("executed", 1, "gaussian", 0.95)
    assert not agent.share_params
    assert (agent.gradient, agent.correction_penalty) == ("per_agent", 0.0)


def test_methods_are_different_runs_and_say_what_they_are():
    names = [path.stem for path in (CONF / "method").glob("*.yaml")]
    composed_methods = {name: composed(f"method={name}") for name in names}
    hashes = {name: config_hash(cfg) for name, cfg in composed_methods.items()}
    assert hashes["default"] == hashes["certified"]
    assert len(set(hashes.values())) == len(names) - 1
    assert all(config_hash(composed(f"method={name}", "seed=3")) == hashes[name] for name in names)
    configs = {name: to_config(cfg) for name, cfg in composed_methods.items()}
    modes = {name: config.safety.mode for name, config in configs.items() if config.safety.mode != "certified"}
    assert modes == {
        "stacked_filter": "paper",
        "paper_filter": "paper",
        "dalal": "dalal",
        "unfiltered": "none",
        "violation_penalty": "none",
    }
    assert all((config.env.on_violation == "continue") == (name in modes) for name, config in configs.items())
    assert configs["ddpg"].agent == dataclasses.replace(configs["certified"].agent, algorithm="ddpg")
    assert configs["separate"].agent == AgentConfig()
    assert configs["violation_penalty"].train.violation_penalty > 0
    benchmark = (CONF / "experiment" / "benchmark.yaml").read_text()
    assert set(benchmark.split("method: ")[-1].split()[0].split(",")) == set(names) - {"default"}


def test_a_run_shorter_than_its_targets_is_refused():
    with pytest.raises(ValueError, match=r"agent\.n_steps=5 is longer than the run.*4 steps of every world"):
        to_config(composed("collector.total_frames=1000"))
    to_config(composed("collector.total_frames=1250"))


def test_methods_compose_with_experiments_and_give_way_to_the_command_line():
    config = to_config(composed("experiment=paper", "method=ddpg"))
    assert (config.agent.algorithm, config.agent.n_steps) == ("ddpg", 1)
    assert to_config(composed("method=unfiltered", "env.on_violation=terminate")).env.on_violation == "terminate"
    assert to_config(composed("method=paper_filter", "safety=none")).safety.mode == "none"


def test_paper_run_is_the_papers_budget():
    config = to_config(composed("experiment=paper"))
    assert config.collector.total_frames == 1_000_000
    assert config.collector.num_envs == 100
    assert config.collector.frames_per_batch == 100
    assert config.env.horizon == 100
    assert config.buffer.batch_size == 256
    assert config.agent.actor_cells == [64, 64]
    assert config.agent.critic_cells == [64, 64]
    assert config.train.n_updates == 1
    assert config.checkpoint.interval_episodes == 100
    literal = to_config(composed("experiment=paper_literal"))
    for run, updates in ((config, 10_000), (literal, 1_000_000)):
        # as train.py counts: an update after every batch whose frames have reached the warm-up
        per_batch, total = run.collector.frames_per_batch, run.collector.total_frames
        batches = sum(frames >= run.train.warmup_frames for frames in range(per_batch, total + 1, per_batch))
        assert batches * run.train.n_updates == updates


def test_literal_filter_is_one_row_with_full_responsibility():
    safety = to_config(composed("safety=paper")).safety
    assert (safety.composition, safety.split, safety.sampled_data) == ("min", "full", False)
    default = to_config(composed()).safety
    assert (default.mode, default.composition, default.split) == ("certified", "stacked", "auto")


def test_hash_ignores_what_does_not_change_the_result():
    reference = config_hash(composed())
    same = ("seed=5", "device=cpu", "resume=never", "debug=true", "checkpoint.keep=7")
    assert all(config_hash(composed(override)) == reference for override in same)
    assert config_hash(composed("env.n_agents=4")) != reference


@pytest.mark.parametrize(
    "override", ["foo=1", "env.foo=1", "env.n_agents=abc", "agent.gamma=high", "safety=unheard_of"]
)
def test_unknown_names_and_wrong_types_do_not_compose(override):
    with pytest.raises((HydraException, OmegaConfBaseException)):
        composed(override)


BAD = [
    ("env.n_agents=0", "[1, 64]"),
    ("env.density=foo", "uniform, gaussian_mixture, moving, age"),
    ("env.stations=[[0,0]]", "1 slots for env.n_agents=3"),
    ("env.stations=[[0,0],[0,0.05],[0.5,0.5]]", "overlap"),
    ("env.charge_rate=0.01", "could never charge"),
    ("env.arena=[[0,1]]", "2 or 3 rows"),
    ("env.energy_min=2", "energy_max"),
    ("safety.alpha_s=100", "(0, 5.0]"),
    ("safety.split=all", "half, full, joint"),
    ("safety.dalal_margin=-1", "[0, 100]"),
    ("collector.total_frames=1000", "nearest that is, is 992"),
    ("agent.gamma=1", "below 1"),
    ("agent.correction_penalty=1", "safety.in_loss=true"),
    ("buffer.capacity=1", "one minibatch"),
    ("device=tpu", "auto, cpu, cuda"),
    ("resume=maybe", "neither auto nor never"),
]


@pytest.mark.parametrize(("override", "hint"), BAD)
def test_bad_value_gives_one_clear_error_and_no_folder(program, tmp_path, override, hint):
    code, output = program(train.main, "experiment=smoke", override)
    assert code == 1
    assert override.split("=")[0] in output
    assert hint in " ".join(output.split())
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) <= 8
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ((), "give one of run=<folder> and controller=<name>"),
        (("controller=unheard_of",), "random, lloyd, charge_when_low, coverage_cbf"),
        (("run=nowhere",), "is not the folder of a run"),
        (("controller=lloyd", "run=nowhere"), "give one of"),
        (("controller=lloyd", "steps=-1"), "steps=-1"),
    ],
)
def test_bad_evaluation_gives_one_clear_error_and_no_folder(program, tmp_path, arguments, hint):
    code, output = program(evaluate.main, *arguments)
    assert code == 1
    assert hint in " ".join(output.split())
    assert "Traceback" not in output
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback(program):
    code, output = program(train.main, "experiment=smoke", "env.n_agents=0", "debug=true")
    assert code == 1
    assert "Traceback" in output


def test_yaml_files_hold_differences_only():
    """A value in env/default.yaml would silently differ from SurveillanceConfig() in Python; one is meant to."""
    assert to_config(composed()) == Config(agent=AgentConfig(share_params=True))
    assert Path(CONF / "env" / "default.yaml").read_text().strip().endswith("{}")
