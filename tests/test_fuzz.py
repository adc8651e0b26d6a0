"""Random overrides: each composes to a valid run, or is refused with one clear message and nothing on disk.

``FUZZ_CASES=1000 pytest tests/test_fuzz.py`` tries more (the study in docs/results.md).
"""

import os
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.errors import HydraException

import evaluate
import report
import train
from agents.controllers import CONTROLLERS
from conf.evaluate_schema import EvaluateConfig
from conf.manual import defaults, documentation, explain
from conf.report_schema import ReportConfig
from conf.schema import Config

COUNT = int(os.environ.get("FUZZ_CASES", "160"))
CHUNKS = 8
GROUPS = ("env", "safety", "agent", "train", "experiment", "method")
ROOT = Path(train.__file__).parent
CONF = ROOT / "conf"
STRANGE = (
    *(
        "",
        "null",
        "true",
        "false",
        "nan",
        "inf",
        "-inf",
        "0",
        "1",
        "-1",
        "2",
        "0.5",
        "1e-9",
        "1e9",
        "1e400",
        "-0.0",
        "3.7",
    ),
    *(
        "auto",
        "never",
        "paper",
        "none",
        "certified",
        "abc",
        "a b",
        "ä",
        "[]",
        "[1]",
        "[1,2]",
        "[0.5,a]",
        "[[0,0]]",
        "[[1,2],[3]]",
    ),
    *(
        "{}",
        "{a:1}",
        "{a:{b:2}}",
        "${seed}",
        "${nope}",
        "${oc.env:HOME}",
        "${config_hash:}",
        "'1'",
        '"x y"',
        "'",
        '"',
        "\\",
        "1,2",
    ),
    *(
        "range(3)",
        "choice(1,2)",
        "[",
        "]",
        "{",
        "1_000",
        "0x10",
        "1e",
        "--",
        "?",
        "*",
        "???",
        "a=b",
        "=",
        ":",
        "@",
        "~",
        "+",
    ),
    *("/tmp", "nowhere.pt", "9" * 30, "x" * 300),
)


def options(group):
    return [path.stem for path in (CONF / group).glob("*.yaml")]


def number(draw):
    """A number of any size, often one that a field could take."""
    near = draw.choice((1, 2, 3, 5, 8, 16, 64, 100, 0.1, 0.2, 0.01, 0.9, 1e-3, 1000))
    return draw.choice((near, near, near, -near, near * draw.choice((1e-3, 10, 1e6)), round(near)))


def one(draw, names, schema=Config, groups=GROUPS):
    """One override: of a known option, a group, or something that is no override at all."""
    kind = draw.random()
    if kind < 0.12 and groups:
        group = draw.choice(groups)
        return f"{group}={draw.choice([*options(group), *options(group), draw.choice(STRANGE)])}"
    if kind < 0.2:
        name = draw.choice([*names, "x", "env.x", "hydra.x", "agent"])
        return draw.choice(("", "+", "++", "~")) + name + draw.choice(("", "=1", "="))
    if kind < 0.24:
        return draw.choice(STRANGE) + draw.choice(STRANGE)
    name = draw.choice(names)
    start = defaults(schema)[name]
    if kind < 0.4:
        value = draw.choice(STRANGE)
    elif isinstance(start, bool):
        value = draw.choice(("true", "false"))
    elif isinstance(start, str):
        words = (
            documentation(schema)[name].replace(":", " ").replace("|", " ").replace(",", " ").replace(".", " ").split()
        )
        value = draw.choice([start, start, *words[:6]])
    else:
        value = (
            draw.choice((start, number(draw), number(draw)))
            if start is None or isinstance(start, int | float)
            else start
        )
    return f"{name}={value}".replace(" ", "")


def draws(chunk):
    """Overrides of one chunk of the cases, one to three a case."""
    draw, names = random.Random(chunk), [name for name in defaults(Config) if name != "debug"]
    return [[one(draw, names) for _ in range(draw.choice((1, 1, 2, 3)))] for _ in range(COUNT // CHUNKS)]


ACCEPTED = 77


def check_refusal(code, output, told):
    """One clear message."""
    assert code == 1, told
    lines = output.strip().splitlines()
    assert 1 <= len(lines) <= 8, told
    assert lines[0].startswith("error: "), told
    assert all(len(line) <= 130 for line in lines), told


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_random_overrides(program, tmp_path, monkeypatch, chunk, record_property):
    def stop(*_):
        sys.exit(ACCEPTED)

    monkeypatch.setattr(train, "pick_device", stop)  # the first thing after validation
    accepted = 0
    for overrides in draws(chunk):
        code, output = program(train.main, *overrides)
        told = f"{overrides}\n{output}"
        assert "Traceback" not in output, told
        if code == ACCEPTED:
            accepted += 1
            continue
        check_refusal(code, output, told)
    folders = [path.parent.name for path in tmp_path.rglob("*") if path.is_dir() and path.name == ".hydra"]
    assert len({name.partition("_seed")[0] for name in folders}) <= accepted  # of accepted programs only
    record_property("accepted", accepted)
    assert 0 < accepted < COUNT // CHUNKS


def test_accepted_configurations_run(program, tmp_path):
    """The first steps of a sample of those that validation lets pass."""
    small = (
        *("collector.num_envs=2", "collector.steps_per_batch=5", "collector.total_frames=20", "buffer.batch_size=4"),
        *("buffer.capacity=32", "train.warmup_frames=4", "train.n_updates=1", "eval.num_envs=1", "eval.steps=2"),
        *("eval.interval_frames=0", "device=cpu", "agent.n_steps=1", "safety.dalal_steps=5", "compile=false"),
        *("log.figures=false", "log.gif=false", "resume=auto"),
    )
    draw, names, ran, tried = random.Random(0), list(defaults(Config)), 0, 0
    fixed = {entry.split("=")[0] for entry in small}
    while ran < 12:
        tried += 1
        overrides = [one(draw, [name for name in names if name not in fixed]) for _ in range(2)]
        if any(
            entry.split("=")[0].lstrip("+~") in (*fixed, "train", "experiment", "method", "threads", "debug")
            for entry in overrides
        ):
            continue
        if any(entry.startswith(("hydra", "agent.actor_cells", "agent.critic_cells")) for entry in overrides):
            continue
        code, output = program(train.main, *overrides, *small)
        assert "Traceback" not in output, (overrides, output)
        assert code in (0, 1)
        ran += code == 0
        assert (code == 0) or output.startswith("error: "), (overrides, output)
    assert len(list(tmp_path.glob("runs/*/*/summary.json"))) >= 1
    assert tried < 200


def test_every_option_is_documented():
    start, text = defaults(Config), documentation(Config)
    assert set(start) == set(text)
    assert not [name for name, words in text.items() if len(words) < 10]


@pytest.mark.parametrize(
    ("main", "schema", "groups"),
    [
        (train.main, Config, GROUPS),
        (evaluate.main, EvaluateConfig, ("env", "safety")),
        (report.main, ReportConfig, ()),
    ],
)
def test_help_is_a_manual(program, main, schema, groups):
    code, output = program(main, "--help")
    assert code == 0
    for name in defaults(schema):
        assert f"  {name}=" in output
    for group in GROUPS:
        line = output.split(f"\n  {group}: ")[1:2]
        assert bool(line) == (group in groups)
        assert all(option in "".join(line) for option in (options(group) if line else ()))
    assert "$" not in output
    assert max(map(len, output.splitlines())) <= 132


def test_every_controller_is_in_the_manual():
    text = documentation(EvaluateConfig)["controller"]
    assert set(CONTROLLERS) == set(re.sub("[a-zA-Z]+:|[|.]", " ", text).split())


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("agent=foo", "error: agent=foo: group agent has no option 'foo'. Choose one of ddpg, maddpg, paper."),
        ("agent.lr=1", "Did you mean agent.actor_lr"),
        (
            "envs.n_agents=5",
            "error: Key 'envs' not in 'Config'. There is no option 'envs.n_agents'. Did you mean env.n_agents",
        ),
        ("evn=ring", "There is no option 'evn'. Did you mean env?"),
        ("methd=ddpg", "There is no option 'methd'. Did you mean method? python"),
        ("colector.num_envs=5", "Did you mean collector.num_envs or eval.num_envs"),
        ("agent.actor_lr=abc", "agent.actor_lr: Learning rate of the actors (Adam), (0, 1]."),
        ("collector=5", "collector is a group; its options: collector.num_envs"),
        ("+agent.x=1", "There is no option 'agent.x'"),
        ("~seed", "~seed: options cannot be deleted"),
        ("~agent", "~agent: groups cannot be deleted; choose a file of it with agent=<name>."),
        ("~env=default", "~env=default: groups cannot be deleted"),
        ("a", "'a' is not an override"),
        ("env=[1]", "Hydra cannot combine these overrides"),
        ("--x=1", "'--x=1' is neither a flag nor an override"),
        ("-c", "expected one argument"),
        ("seed=1,2", "add --multirun"),
        ("hydra.run.dir=" + "x" * 300, "File name too long"),
    ],
)
def test_an_error_names_the_remedy(program, tmp_path, override, message):
    code, output = program(train.main, override)
    assert code == 1
    assert message in " ".join(output.split())
    assert len(output.strip().splitlines()) <= 8
    assert not list(tmp_path.iterdir())


def test_a_group_of_another_program_is_refused_in_whole_sentences(program):
    code, output = program(evaluate.main, "controller=lloyd", "agent=ddpg")
    assert code == 1
    text = " ".join(output.split())
    assert "Could not override 'agent'. No match in the defaults list. There is no option 'agent'. python" in text


def test_a_reader_that_has_read_enough_ends_a_program_silently():
    """As ``--help | head -3`` does, whatever of the text the pipe still takes."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "train.py", "--help"], cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def test_hydra_can_speak_for_itself(program, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(HydraException):
        program(train.main, "agent=foo")


def test_unknown_options_are_guessed():
    assert "agent.actor_lr" in explain(Config, "agent.lr")
    assert "env.n_agents" in explain(Config, "env.num_agents")
    assert "Number of robots" in explain(Config, "env.n_agents")
    assert "collector.num_envs" in explain(Config, "collector")
    assert explain(Config, "zzz") == "There is no option 'zzz'."
    assert "method" not in explain(EvaluateConfig, "methd")


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX shells")
def test_one_bad_job_of_a_sweep(program, tmp_path):
    tiny = (
        "experiment=smoke",
        "collector.total_frames=256",
        "eval.interval_frames=0",
        "log.gif=false",
        "log.figures=false",
    )
    code, output = program(train.main, "-m", *tiny, "env.n_agents=0,2", "agent.gamma=0.9")
    assert code == 1
    assert "1 of the sweep's runs failed; the others are complete" in output
    assert "env.n_agents=0 agent.gamma=0.9: env.n_agents=0 is out of range" in output
    assert "ended: " not in output  # the runs' own output is there
    assert "runs complete in" not in output
    assert "Traceback" not in output
    assert len(list(tmp_path.glob("runs/smoke/*/summary.json"))) == len(list(tmp_path.glob("runs/smoke/*/"))) == 1
