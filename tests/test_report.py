"""report.py on synthetic run folders against hand computation, and once on real runs."""

import json
import math
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

import evaluate
import report
import train
from agents.report_runs import ReportError, Run, check_runs, find_runs, read_events
from agents.report_statistics import (
    ALL,
    BOUND,
    Bootstrap,
    Groups,
    compute_curves,
    compute_rows,
    improvement,
    iqm,
    ratio,
)
from agents.report_tables import find_method, number
from conf.naming import config_hash
from envs import SurveillanceConfig
from envs.centroidal import centroidal_cost
from tests.synthetic_runs import read, write_run


@pytest.fixture
def sweep(tmp_path):
    """Eight seeds of two learned methods and a controller in one world; an outlier separates IQM and mean."""
    for seed, cost in enumerate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 100.0]):
        deep = {"events": seed < 2, "config_hash": "c0ffee00"}
        write_run(tmp_path / "sweep" / "deep", seed, cost, "agent=ddpg", **deep)
        write_run(tmp_path / "sweep", seed, cost / 10, "safety=none", violations={"collision": 2}, events=False)
        write_run(tmp_path / "sweep", seed, 2.0, controller="coverage_cbf")
    return tmp_path / "sweep"


def table(folder):
    return {(r["world"], r["method"], r["quantity"], r["against"]): r for r in read(folder / "report" / "table.csv")}


def messages(output):
    return " ".join(output.split())


@pytest.fixture
def no_figures(monkeypatch):
    """Drawing takes most of a report's time; for reports of which only numbers and texts are looked at."""
    monkeypatch.setattr(report, "save_figures", lambda *_: [])


# ---- statistics


def test_iqm_leaves_the_outer_quarters_out():
    assert iqm(np.array([100.0, 1, 2, 3, 4, 5, 6, 7])) == pytest.approx((3 + 4 + 5 + 6) / 4)
    assert iqm(np.array([1.0, 2, 9])) == pytest.approx(4)  # a quarter of three is none
    assert iqm(np.array([[0.0, 1, 2, 50], [5, 5, 7, 99]])).tolist() == [1.5, 6.0]


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ([1, 2], [3, 4, 5], 1.0),
        ([3, 4, 5], [1, 2], 0.0),
        ([1, 2], [1, 2], 0.5),
        ([7, 7], [7, 7], 0.5),
        ([1, 3], [2, 4], 0.75),
        ([1, 2, 2], [2, 3], (2 + 1.5 + 1.5) / 6),
    ],
)
def test_probability_of_improvement_counts_pairs(x, y, expected):
    assert improvement(np.array(x, float), np.array(y, float)) == pytest.approx(expected)


def test_interval_contains_the_value_and_shrinks_with_the_spread():
    generator = np.random.default_rng(3)
    sample = generator.normal(5, 1, 20)
    wide, narrow = Bootstrap()(iqm, sample), Bootstrap()(iqm, 5 + (sample - 5) / 10)
    assert wide.low < wide.value < wide.high
    assert narrow.high - narrow.low == pytest.approx((wide.high - wide.low) / 10)
    # the normal approximation of a mean, roughly
    mean = Bootstrap()(lambda x, axis: x.mean(axis), sample)
    half = 1.96 * sample.std() / 20**0.5
    assert (mean.high - mean.low) / 2 == pytest.approx(half, rel=0.05)
    ninety = Bootstrap(confidence=0.9)(lambda x, axis: x.mean(axis), sample)
    assert ninety.high - ninety.low == pytest.approx((mean.high - mean.low) * 1.645 / 1.96, rel=0.05)


def test_no_interval_for_one_seed_or_an_unmeasured_one():
    one, three = np.array([4.0]), np.array([1.0, 2.0, 3.0])
    for samples in ((one, three), (three, one), (np.array([1.0, np.nan, 2.0]), three)):
        found = Bootstrap()(ratio, *samples)
        assert math.isnan(found.low)
        assert math.isnan(found.high)
    assert Bootstrap()(ratio, one, three).value == pytest.approx(2.0)


def test_ratio_of_several_worlds_is_stratified():
    # each world's J is the same for all seeds: nothing is left to resample unless worlds are mixed
    x, y = [np.full(3, 1.0), np.full(5, 3.0)], [np.full(4, 2.0), np.full(4, 4.0)]
    found = Bootstrap()(ratio, *x, *y)
    expected = np.mean([0.5, 0.75, 0.75, 0.75])  # of 0.5 x 3 and 0.75 x 5 without the outer two at either side
    assert (found.value, found.low, found.high) == pytest.approx((expected, expected, expected))
    # by hand, with a spread: world A scaled by IQM([1, 3]) = 2, world B by 10
    found = ratio(np.array([2.0, 4.0]), np.array([5.0, 30.0]), np.array([1.0, 3.0]), np.array([10.0, 10.0]))
    assert found == pytest.approx((1.0 + 2.0) / 2)  # of 1, 2, 0.5, 3 the middle two


def test_improvement_over_worlds_is_their_mean():
    x, y = [np.array([1.0, 2]), np.array([9.0, 9])], [np.array([3.0, 4]), np.array([9.0, 9])]
    assert improvement(*x, *y) == pytest.approx(0.75)


# ---- reports of synthetic runs


def test_numbers_by_hand(program, sweep):
    code, output = program(report.main, "sweep=sweep", "against=none", "resamples=500")
    assert code == 0, output
    rows = table(sweep)
    found = rows["default", "agent=ddpg", "coverage_cost.iqm", ""]
    assert float(found["value"]) == 4.5
    assert float(found["low"]) < 4.5 < float(found["high"])
    assert found["seeds"] == "8"
    assert float(rows["default", "agent=ddpg", "coverage_cost.mean", ""]["value"]) == 16.0
    costs = np.array([1, 2, 3, 4, 5, 6, 7, 100])
    expected = math.sqrt(((costs - 16.0) ** 2).sum() / 7)
    assert float(rows["default", "agent=ddpg", "coverage_cost.std", ""]["value"]) == pytest.approx(expected)
    cbf = "coverage_cbf + certified"
    assert float(rows["default", "agent=ddpg", "coverage_cost.ratio", cbf]["value"]) == 2.25
    bound = centroidal_cost(SurveillanceConfig(horizon=20))
    assert float(rows["default", BOUND, "coverage_cost.bound", ""]["value"]) == bound
    gap = rows["default", "agent=ddpg", "gap_closed", cbf]
    assert float(gap["value"]) == pytest.approx((2.0 - 4.5) / (2.0 - bound))
    assert float(gap["low"]) < float(gap["value"]) < float(gap["high"])
    pairs = (1 + 0.5) / 8  # J of 1 is below 2, J of 2 ties
    assert float(rows["default", "agent=ddpg", "probability_of_improvement", cbf]["value"]) == pairs
    assert float(rows["default", "safety=none", "probability_of_improvement", cbf]["value"]) == 7 / 8
    assert not any(method == cbf and quantity == "probability_of_improvement" for _, method, quantity, _ in rows)

    def value(method, quantity):
        return float(rows["default", method, quantity, ""]["value"])

    assert value("safety=none", "eval.violations.collision") == 16  # summed over the seeds
    assert value("safety=none", "eval.violations.stranded") == 0
    assert value("safety=none", "train.violations.stranded") == sum(range(8))
    assert value("safety=none", "train.robot_steps") == 8 * 100 * 3
    assert value("safety=none", "train.hold_rate.mean") == pytest.approx(0.02)
    assert value(cbf, "eval.homing_rate.mean") == pytest.approx(0.01)
    assert rows["default", cbf, "train.robot_steps", ""]["value"] == ""  # a controller is not trained

    text = (sweep / "report" / "report.md").read_text()
    assert "| agent=ddpg | 8 | 4.5 [" in text
    assert "| 2.25 [" in text
    assert "1 (reference) | 0 (reference)" in text
    assert f"unlimited batteries: J = {bound:.4g}." in text
    assert "| safety=none | testing | 480 | 0 | 0 | 0 | 16 |" in text
    assert "P(better than safety=none)" in text
    order = [text.index(f"| {name} | 8 |") for name in ("safety=none", cbf, "agent=ddpg")]
    assert order == sorted(order)  # best first
    assert "no TensorBoard events in 6 runs" in text
    assert str(sweep.name) in text.splitlines()[0]
    assert {path.name for path in (sweep / "report").iterdir()} == set(report.FILES)
    assert not list(sweep.glob(".report_*"))
    for name in ("curves", "rates"):
        with Image.open(sweep / "report" / f"{name}.png") as picture:
            assert picture.size[0] > 400
        assert "<svg" in (sweep / "report" / f"{name}.svg").read_text()
    assert "coverage_cbf + certified" in (sweep / "report" / "curves.svg").read_text()  # the reference's line


@pytest.mark.usefixtures("no_figures")
def test_csv_files_read_back(program, sweep):
    code, output = program(report.main, "sweep=sweep", "resamples=100")
    assert code == 0, output
    runs = read(sweep / "report" / "runs.csv")
    assert len(runs) == 24
    (run,) = [row for row in runs if (row["method"], row["seed"]) == ("agent=ddpg", "7")]
    assert run["name"] == "deep/default_agent=ddpg_7"
    assert (run["config_hash"], run["learned"]) == ("c0ffee00", "True")
    assert float(run["eval.coverage_cost"]) == 100.0
    assert float(run["train.filter.homing_rate"]) == 0.01
    (controller,) = [row for row in runs if (row["method"], row["seed"]) == ("coverage_cbf + certified", "3")]
    assert float(controller["eval.filter.fallback_rate"]) == 0.03
    assert float(controller["eval.task.waypoints"]) == 7
    assert controller["frames"] == ""
    curves = read(sweep / "report" / "curves.csv")
    assert {row["method"] for row in curves} == {"agent=ddpg"}
    cost = [row for row in curves if row["quantity"] == "coverage_cost"]
    assert [int(row["frames"]) for row in cost] == [0, 32, 64, 96]
    assert [float(row["value"]) for row in cost] == [4.5, 3.5, 2.5, 1.5]  # seeds 0 and 1 have events
    assert [float(row["low"]) for row in cost] == [4.0, 3.0, 2.0, 1.0]
    seconds = [float(row["wall_time_s"]) for row in cost]
    assert np.diff(seconds) == pytest.approx([10, 10, 10], abs=0.01)
    assert 0 <= seconds[0] < 5
    hold = [float(row["value"]) for row in curves if row["quantity"] == "hold_rate"]
    assert hold == pytest.approx([0.02] * 4)


def test_one_seed_has_no_interval(program, tmp_path):
    write_run(tmp_path / "sweep", 0, 3.0, "agent=ddpg")
    write_run(tmp_path / "sweep", 0, 1.5, controller="coverage_cbf")
    code, output = program(report.main, "sweep=sweep")
    assert code == 0, output
    text = (tmp_path / "sweep/report/report.md").read_text()
    assert "| agent=ddpg | 1 | 3 – | 3 | – | 2 – |" in text
    assert "| agent=ddpg | 0 – |" in text  # P(better)
    assert all(row["low"] == row["high"] == "" for row in read(tmp_path / "sweep/report/table.csv"))
    assert all(row["low"] == "" for row in read(tmp_path / "sweep/report/curves.csv"))


def test_several_worlds(program, tmp_path, monkeypatch):
    sweep, cbf = tmp_path / "sweep", "coverage_cbf + certified"
    for seed in range(2):
        for world, cost in (("default", 2.0), ("aerial", 20.0)):
            write_run(sweep, seed, cost, controller="coverage_cbf", world=world)
            write_run(sweep, seed, cost * (0.4 + seed), method="maddpg", world=world)
        write_run(sweep, seed, 1.0, method="only_here")
    code, output = program(report.main, "sweep=sweep", "resamples=300")
    assert code == 0, output
    rows = table(sweep)
    assert {world for world, *_ in rows} == {"default", "aerial", ALL}
    assert float(rows["aerial", "maddpg", "coverage_cost.iqm", ""]["value"]) == pytest.approx(18.0)
    found = rows[ALL, "maddpg", "coverage_cost.ratio", cbf]
    assert [float(found[name]) for name in ("value", "low", "high")] == pytest.approx(
        [0.9, 0.4, 1.4]
    )  # of 0.4, 1.4 twice
    assert float(rows[ALL, "maddpg", "probability_of_improvement", cbf]["value"]) == 0.5
    text = (sweep / "report/report.md").read_text()
    assert f"| maddpg | 0.9 [0.4, 1.4] |\n| {cbf} | 1 (reference) |" in text.split("## all worlds")[1]  # best first
    assert "left out: only_here" in text

    write_run(sweep, 0, 5.0, "env.n_agents=5", method="maddpg", name="larger")  # another world, without the reference
    monkeypatch.setattr(report, "save_figures", lambda *_: [])
    code, output = program(report.main, "sweep=sweep", "resamples=300")
    assert code == 0, output
    assert float(table(sweep)["default n_agents=5", "maddpg", "coverage_cost.iqm", ""]["value"]) == 5.0
    assert f"The reference {cbf} does not have runs in every world" in (sweep / "report/report.md").read_text()


@pytest.mark.usefixtures("no_figures")
def test_what_lies_in_a_run_is_no_run(program, sweep):
    run = sweep / "deep" / "default_agent=ddpg_0"
    write_run(run / "replaced_1", 0, 77.0, "agent=ddpg", name=".")
    write_run(sweep / "replaced_2", 0, 77.0, "agent=ddpg")
    write_run(run, 0, 77.0, controller="lloyd", name="eval/default_20_0")
    code, output = program(report.main, "sweep=sweep", "resamples=100")
    assert code == 0, output
    assert len(read(sweep / "report" / "runs.csv")) == 24
    assert "in no table: deep/default_agent=ddpg_0/eval/default_20_0" in (sweep / "report" / "report.md").read_text()
    assert "warning: default / agent=ddpg: no TensorBoard events in 6 runs" in output


def test_a_second_report_replaces_the_first(program, sweep):
    program(report.main, "sweep=sweep", "resamples=100")
    first = (sweep / "report/report.md").read_text()
    (sweep / "report/mine.txt").write_text("kept")
    for folder in (sweep / "deep").iterdir():
        for events in folder.glob("events*"):
            events.unlink()
    code, output = program(report.main, "sweep=sweep", "resamples=200")
    assert code == 0, output
    assert (sweep / "report/report.md").read_text() != first
    names = {path.name for path in (sweep / "report").iterdir()}
    assert names == {"report.md", "runs.csv", "table.csv", "curves.csv", "mine.txt"}  # no stale figures


def test_a_failed_report_leaves_the_old_one(program, sweep, monkeypatch):
    program(report.main, "sweep=sweep", "resamples=100")
    before = {path: path.read_bytes() for path in (sweep / "report").iterdir()}

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(report, "write_curves", full)
    code, output = program(report.main, "sweep=sweep", "resamples=100")
    assert code == 1
    assert "No space left" in output
    assert {path: path.read_bytes() for path in (sweep / "report").iterdir()} == before
    assert not list(sweep.glob(".report_*"))


# ---- what is refused

ERRORS = {
    "unfinished": (
        lambda s: write_run(s, 8, None, "agent=ddpg", name="killed"),
        ["unfinished: killed", "incomplete=true"],
    ),
    "missing": (lambda s: write_run(s, 0, 1.0, "agent=new"), ["default / agent=new / seed 1", "and 4 more"]),
    "twice": (
        lambda s: write_run(s, 3, 1.0, "agent=ddpg", name="again"),
        ["several runs of one seed: default / agent=ddpg / seed 3 (again, deep/default_agent=ddpg_3)"],
    ),
    "other configuration": (
        lambda s: [write_run(s, k, 1.0, method="m", config_hash=f"{k // 4}234") for k in range(8)],
        ["default / m (0234 (4 runs), 1234 (4 runs))"],
    ),
    "other configuration of a controller": (
        lambda s: [write_run(s, k, 1.0, controller="lloyd", steps=20 + k // 7) for k in range(8)],
        ["default / lloyd + certified (", "(7 runs)", "(1 runs)"],
    ),
    "damaged": (
        lambda s: (s / "deep/default_agent=ddpg_1/summary.json").write_text("{"),
        ["agent=ddpg_1/summary.json cannot be read"],
    ),
}


@pytest.mark.parametrize(("spoil", "expected"), ERRORS.values(), ids=ERRORS.keys())
def test_errors_name_the_runs(program, sweep, spoil, expected):
    spoil(sweep)
    code, output = program(report.main, "sweep=sweep")
    assert code == 1
    for text in expected:
        assert text in messages(output)
    assert "Traceback" not in output
    assert len(output.splitlines()) <= 8
    assert not (sweep / "report").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["sweep=nowhere"], "sweep=nowhere is not a folder"),
        (["sweep=empty"], "sweep=empty holds no runs"),
        ([], "sweep=<folder> is missing"),
        (["sweep=sweep", "resamples=1"], "resamples=1 is out of range"),
        (["sweep=sweep", "confidence=1.0"], "confidence=1.0 is out of range"),
        (["sweep=sweep", "reference=lloyd"], "reference=lloyd names none of: agent=ddpg, coverage_cbf + certified"),
        (["sweep=sweep", "against=e"], "against=e names several of: agent=ddpg, coverage_cbf"),
    ],
)
def test_errors_of_the_command_line(program, tmp_path, sweep, arguments, expected):
    (tmp_path / "empty").mkdir()
    before = set(tmp_path.rglob("*"))
    code, output = program(report.main, *arguments)
    assert code == 1
    assert expected in messages(output)
    assert "Traceback" not in output
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.usefixtures("no_figures")
def test_incomplete_reports_what_there_is_and_says_so(program, sweep):
    write_run(sweep, 8, None, "agent=ddpg", name="killed")
    write_run(sweep, 0, 1.0, "agent=new")
    write_run(sweep, 1, None, "agent=new", name="killed_too")
    code, output = program(report.main, "sweep=sweep", "incomplete=true", "resamples=100")
    assert code == 0, output
    text = (sweep / "report/report.md").read_text()
    assert "* unfinished: killed, killed_too\n" in text
    missing = text.split("* missing seeds: ")[1].splitlines()[0].split(", ")
    assert "default / agent=new / seed 7" in missing
    assert "default / agent=new / seed 1" not in missing  # unfinished, not missing
    assert "default / safety=none / seed 8" in missing  # a seed that only an unfinished run has
    assert "| agent=new | 1 | 1 – |" in text
    assert len(read(sweep / "report/runs.csv")) == 25


def test_only_unfinished_runs(program, tmp_path):
    write_run(tmp_path / "sweep", 0, None, "agent=ddpg")
    code, output = program(report.main, "sweep=sweep", "incomplete=true")
    assert code == 1
    assert "none of the 1 runs is finished" in output


def runs_of(folder):
    return find_runs(folder, config_hash)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"git_hash": "def"}, "runs of different commits: abc (1 runs), def (1 runs)"),
        (
            {"n_seeds": 10},
            "times of 1 runs are those of programs that trained several seeds at once (n_seeds in runs.csv)",
        ),
        (
            {"env": {"on_violation": "continue"}},
            "world default: env.on_violation is continue (1 runs), terminate (1 runs)",
        ),
        ({"steps": 500}, "world default: J is measured over 20 steps (1 runs), 500 steps (1 runs)"),
        ({"frames": 900}, "world default: trained for 100 frames (1 runs), 900 frames (1 runs)"),
    ],
)
def test_differences_are_told(tmp_path, changes, expected):
    write_run(tmp_path, 0, 1.0, method="a", events=False)
    write_run(tmp_path, 0, 1.0, method="b", events=False, **changes)
    runs, warnings = check_runs(runs_of(tmp_path))
    assert len(runs) == 2
    assert warnings == [expected]


def test_a_run_without_a_finite_cost_is_told_and_not_averaged_away(tmp_path):
    write_run(tmp_path, 0, 1.0, method="a", events=False)
    folder = write_run(tmp_path, 1, 1.0, method="a", events=False)
    content = json.loads((folder / "summary.json").read_text())
    content["eval"]["coverage_cost"] = None
    (folder / "summary.json").write_text(json.dumps(content))
    runs, warnings = check_runs(runs_of(tmp_path))
    assert warnings == ["no finite J: default / a / seed 1"]
    found = {row.quantity: row.value for row in compute_rows(Groups(runs), Bootstrap(100), None)}
    assert math.isnan(found["coverage_cost.iqm"])
    assert number(found["coverage_cost.mean"]) == "–"


@pytest.mark.parametrize(
    ("overrides", "kind", "world", "method"),
    [
        (["agent=ddpg", "safety=none", "device=cpu", "eval.steps=5"], {}, "default", "agent=ddpg safety=none"),
        (["safety=none", "agent=ddpg"], {}, "default", "agent=ddpg safety=none"),  # whatever the order
        (["env=ring", "hydra.launcher.n_jobs=2"], {"world": "ring"}, "ring", "default"),
        (["env.n_agents=5"], {}, "default n_agents=5", "default"),
        (["experiment=smoke", "+agent.gamma=0.9"], {"experiment": "smoke"}, "default", "smoke agent.gamma=0.9"),
        (["env=default"], {"method": "dalal"}, "default", "dalal"),
        (["safety=none"], {"method": "dalal"}, "default", "dalal safety=none"),
        (
            ["env.on_violation=continue"],
            {"controller": "coverage_cbf_literal"},
            "default",
            "coverage_cbf_literal + certified",
        ),
        (["agent=ddpg"], {"method": "default"}, "default", "agent=ddpg"),
        (
            ["controller=ou", "safety.alpha_s=2", "restart=true", "folder=elsewhere"],
            {"controller": "ou"},
            "default",
            "ou + certified safety.alpha_s=2",
        ),
    ],
)
def test_labels(tmp_path, overrides, kind, world, method):
    write_run(tmp_path, 4, None, *overrides, name="run", **kind)
    (run,) = runs_of(tmp_path)
    assert (run.world, run.method, run.seed, run.finished) == (world, method, 4, False)
    assert run.learned == ("controller" not in kind)


def names(folder):
    return [(run.seed, run.world, run.method) for run in runs_of(folder)]


def test_runs_of_one_configuration_are_one_method(program, tmp_path):
    sweep = tmp_path / "sweep"
    write_run(sweep, 0, 2.0, controller="lloyd", steps=7)
    write_run(sweep, 1, 2.0, "video=mp4", controller="lloyd", steps=7, chosen=["default", None, "default"])
    alike = {"experiment": "smoke", "config_hash": "1234", "events": False}
    write_run(sweep, 0, 1.0, "experiment=smoke", name="plain", **alike)
    at_its_default = ("agent.tau=0.01", "env.n_agents=3", "log.gif=False")
    write_run(sweep, 1, 3.0, "experiment=smoke", *at_its_default, name="spelt_out", **alike)
    methods = [(0, "default", "lloyd + certified"), (1, "default", "lloyd + certified")]
    assert names(sweep) == [*methods, (0, "default", "smoke"), (1, "default", "smoke")]
    code, output = program(report.main, "sweep=sweep", "resamples=100", "reference=null")
    assert code == 0, output
    assert "| smoke | 2 | 2 [" in (sweep / "report/report.md").read_text()


@pytest.mark.usefixtures("no_figures")
def test_what_all_trained_methods_share_is_said_once(program, tmp_path):
    sweep, shared = tmp_path / "sweep", ("collector.num_envs=20", "log.gif=False", "threads=2")
    write_run(sweep, 0, 1.0, "agent.tau=0.02", *shared, events=False)
    assert names(sweep) == [(0, "default", "agent.tau=0.02 collector.num_envs=20")]  # one method shares with nobody
    write_run(sweep, 0, 1.0, "agent=ddpg", *shared, events=False)
    write_run(sweep, 0, 1.0, *shared, method="dalal", events=False)
    write_run(sweep, 0, 1.0, *shared, events=False)
    write_run(sweep, 0, 1.0, "safety.alpha_s=2", controller="lloyd")
    found = ["agent.tau=0.02", "agent=ddpg", "dalal", "default", "lloyd + certified safety.alpha_s=2"]
    assert names(sweep) == [(0, "default", name) for name in found]
    code, output = program(report.main, "sweep=sweep", "resamples=100")
    assert code == 0, output
    text = (sweep / "report/report.md").read_text()
    assert "\nAll trained methods have collector.num_envs=20; their names leave it out.\n" in text
    assert "log.gif" not in text


def fake(method, seed=0, world="default", learned=True):
    folder = Path(f"{method}{seed}")
    return Run(folder, method, world, method, seed, learned, "hash", {}, "", 3, finished=True)


def test_methods_are_found_by_their_names():
    groups = Groups(
        [fake("coverage_cbf + certified"), fake("coverage_cbf_literal + certified"), fake("a=1"), fake("a=12")]
    )
    assert find_method(groups, "auto", "reference") == "coverage_cbf + certified"
    assert find_method(groups, "a=1", "reference") == "a=1"
    assert find_method(groups, "literal", "reference") == "coverage_cbf_literal + certified"
    assert find_method(groups, None, "reference") is None
    assert find_method(Groups([fake("a=1")]), "auto", "reference") is None
    with pytest.raises(ReportError, match="against=cbf names several of: coverage_cbf \\+ certified, coverage_cbf_lit"):
        find_method(groups, "cbf", "against")


# ---- curves


def test_curves_use_the_frames_that_all_seeds_have():
    logged = {
        "m0": {"eval/coverage_cost": np.array([[0, 1.0, 5.0], [10, 2.0, 4.0], [20, 3.0, 3.0]])},
        "m1": {"eval/coverage_cost": np.array([[0, 3.0, 7.0], [20, 9.0, 1.0]])},
    }
    (curve,), warnings = compute_curves(
        Groups([fake("m", 0), fake("m", 1)]), Bootstrap(200), lambda run: logged[str(run.folder)]
    )
    assert not warnings
    assert curve.frames.tolist() == [0, 20]
    assert curve.seconds.tolist() == [2.0, 6.0]
    assert curve.estimate.value.tolist() == [6.0, 2.0]
    assert curve.estimate.low.tolist() == [5.0, 1.0]
    assert curve.estimate.high.tolist() == [7.0, 3.0]


def test_long_curves_of_rates_are_means_over_parts_of_the_training():
    points = np.stack([np.arange(1, 101), np.arange(100) * 0.5, np.arange(100) % 2], axis=1)
    tags = {
        "filter/intervention_rate": points,
        "filter/fallback_rate": points,
        "filter/homing_rate": points * (1, 1, 0.25),
    }
    curves, _ = compute_curves(Groups([fake("m")]), Bootstrap(100), lambda run: tags)
    found = {curve.quantity: curve for curve in curves}
    assert found["intervention_rate"].frames.tolist() == list(range(4, 101, 4))
    assert found["intervention_rate"].estimate.value == pytest.approx([0.5] * 25)
    assert found["hold_rate"].estimate.value == pytest.approx([0.375] * 25)
    assert np.isnan(found["hold_rate"].estimate.low).all()  # one seed


def test_controllers_have_no_curves():
    curves, warnings = compute_curves(Groups([fake("lloyd", learned=False)]), Bootstrap(100), lambda run: {})
    assert (curves, warnings) == ([], [])


def test_frames_logged_twice_count_once(tmp_path):
    folder = write_run(tmp_path, 0, 1.0, "agent=ddpg", events=False)
    for values in ((1.0, 2.0), (3.0, 4.0)):
        writer = SummaryWriter(str(folder), filename_suffix=str(values[0]))
        for k, value in enumerate(values):
            writer.add_scalar("eval/coverage_cost", value, global_step=10 + k + (values[0] == 3.0))
        writer.close()
        time.sleep(
            0 if values[0] == 3.0 else 1.1
        )  # event files are read in the order of their names, which hold seconds
    events = read_events(folder, ["eval/coverage_cost", "not/logged"])
    assert set(events.points) == {"eval/coverage_cost"}
    curve = events.curves()["eval/coverage_cost"]
    assert 1 <= curve[1, 1] < 60  # of the second file, in seconds since the first event
    assert curve[:, 0].tolist() == [10, 11, 12]
    assert curve[:, 2].tolist() == [1.0, 3.0, 4.0]


# ---- the program


def test_a_real_sweep(program, tmp_path, monkeypatch):
    tiny = ("experiment=smoke", "collector.total_frames=256", "eval.interval_frames=128", "device=cpu")
    code, output = program(train.main, "-m", *tiny, "seed=0,1")
    assert code == 0, output
    controller = ("controller=coverage_cbf", "seed=0,1", "steps=20", "num_envs=4", "pictures=false", "device=cpu")
    code, output = program(evaluate.main, "-m", *controller)
    assert code == 0, output
    code, output = program(report.main, "sweep=runs", "resamples=200", "pack=kept/runs.tar.xz")
    assert code == 0, output
    assert "warning" not in output
    summaries = [json.loads(path.read_text()) for path in sorted(tmp_path.glob("runs/smoke/*/summary.json"))]
    rows = table(tmp_path / "runs")
    method = "smoke collector.total_frames=256"
    costs = [summary["eval"]["coverage_cost"] for summary in summaries]
    assert len(costs) == 2
    assert float(rows["default", method, "coverage_cost.iqm", ""]["value"]) == pytest.approx(np.mean(costs))
    assert ("default", method, "coverage_cost.ratio", "coverage_cbf + certified") in rows
    assert float(rows["default", method, "train.robot_steps", ""]["value"]) == 2 * 256 * 3
    curves = read(tmp_path / "runs/report/curves.csv")
    assert {row["quantity"] for row in curves} == {"coverage_cost", "intervention_rate", "hold_rate", "homing_rate"}
    assert [row["frames"] for row in curves if row["quantity"] == "coverage_cost"] == ["0", "128", "256"]
    assert float([row for row in curves if row["quantity"] == "coverage_cost"][-1]["value"]) == pytest.approx(
        np.mean(costs)
    )

    # the same on another machine: nothing is done twice, and the report has the same bytes
    monkeypatch.chdir(tmp_path / "kept")
    code, output = program(report.main, "sweep=runs", "unpack=runs.tar.xz")
    assert code == 0, output
    assert "4 runs of runs.tar.xz unpacked, 0 were there" in messages(output)
    before = {path: path.stat().st_mtime for path in Path("runs").rglob("*.json")}
    code, output = program(train.main, "-m", *tiny, "seed=0,1")
    assert (code, output.count("holds a finished run: nothing to do")) == (0, 2), output
    code, output = program(evaluate.main, "-m", *controller, "resume=auto")
    assert (code, output.count("eval.json exists: nothing to do")) == (0, 2), output
    assert {path: path.stat().st_mtime for path in Path("runs").rglob("*.json")} == before
    code, output = program(report.main, "sweep=runs", "resamples=200")
    assert code == 0, output
    for name in ("report.md", "table.csv", "runs.csv", "curves.csv"):
        assert Path("runs/report", name).read_bytes() == (tmp_path / "runs/report" / name).read_bytes()
