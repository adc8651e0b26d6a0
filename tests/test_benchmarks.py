"""The benchmark programs run and print their tables, at tiny sizes. No time is ever asserted."""

import importlib
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parent / "benchmarks"
TINY = ["--batches", "4", "--robots", "2", "--repeats", "1"]


@pytest.fixture
def load(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setenv("RAYON_NUM_THREADS", "1")  # restored afterwards: the programs set it
    return importlib.import_module


@pytest.mark.parametrize(
    ("name", "arguments", "titles"),
    [
        ("bench_qp", ["--problems", "joint"], ["Joint problems, d = 2"]),
        ("bench_qp", ["--dimension", "3", "--problems", "robot"], ["One problem per robot, d = 3"]),
        ("bench_filter", ["--states", "1", "--controllers", "random"], ["Safety filter, d = 2"]),
        ("bench_env_step", ["--no-memory", "--profile"], ["Whole step, d = 2", "Parts of a certified step"]),
        ("bench_update", ["--envs", "4"], ["One update of all robots", "Collection and updates"]),
    ],
)
def test_program(load, capsys, name, arguments, titles):
    with torch.compiler.set_stance("force_eager"):  # test_compilation compiles
        load(name).main([*TINY, *arguments])
    out = capsys.readouterr().out
    for title in titles:
        assert f"### {title}" in out
    assert "Traceback" not in out
    rows = [line.split("|")[1:-1] for line in out.splitlines() if line.startswith("| ")]
    assert all(any(character.isdigit() for character in "".join(row[3:])) for row in rows if row[0].strip().isdigit())


def test_steps_on_a_gpu(load, capsys):
    tiny = ["--batches", "3", "--compiled", "3", "--repeats", "1", "--device", "cpu"]
    with torch.compiler.set_stance("force_eager"):
        load("bench_gpu").main(tiny)
    out = capsys.readouterr().out
    assert [out.count(f" {kind} |") for kind in ("selecting", "fixed sizes", "fixed sizes, compiled")] == [1, 1, 1]


def test_solvers_answer_the_same_problems(load):
    """Solutions and gradients agree with the exact solver's, so the times are of the same work.

    Only most of stock qpth's are right, and proxsuite's gradients are off by a hundredth whatever its tolerances.
    """
    bench = load("bench_qp")
    found = bench.collect(load("harness").make_world(3), 12, ["robot", "ball"], "cpu")
    reference = bench.Solver(found["robot"].head(12), "exact", 1)
    value = reference.forward()
    expected = [value, *reference.backward(value)]
    assert bench.judge(reference.problems, reference.answer)[0] == 100
    for name, (kind, build) in bench.contestants("robot", "cpu").items():
        solver = build(found[kind].head(12), threads=1)
        if kind == "ball" or len(solver.chain()) == 1:
            continue
        answer = solver.forward()
        errors = [
            (mine - theirs).abs().flatten(1).amax(1)
            for mine, theirs in zip(expected, [answer, *solver.backward(answer)], strict=True)
        ]
        if name == bench.PROX:
            assert errors[0].max() < 1e-3
            assert errors[1].max() < 0.1
        else:
            assert all((e.median() if name == bench.STOCK else e.max()) < 1e-4 for e in errors), name


def test_what_the_budget_does_not_allow_is_a_dash_with_its_reason(load, capsys):
    load("bench_filter").main([*TINY, "--filters", "certified", "--controllers", "random", "--seconds", "0"])
    assert "expected to take more than 0 s" not in capsys.readouterr().out  # a first, smallest size is always run
    harness = load("harness")
    budget = harness.Budget(harness.make_parser(None, batches="1", robots="1").parse_args(["--seconds", "1"]))
    budget.seen["slow", 3] = (64, 0.5)
    assert budget.medians({"slow": (lambda: None,)}, 512, 3) == {"slow": None}
    assert "more than 1 s" in budget.footnote()
    assert "slow" in budget.footnote()


def test_accuracy_program(load, capsys):
    """Every category once per solver; the status says that Clarabel and the differences agree."""
    status = load("qp_accuracy").main(["--problems", "15", "--solvers", "exact,active_set"])
    out = capsys.readouterr().out
    assert status == 0, out
    rows = [line.split("|")[1:-1] for line in out.splitlines() if line.startswith("| ")]
    assert sum(row[0].strip() == "1" for row in rows) == 30
    assert sum(row[0].strip() == "15" for row in rows) == 2


def test_kill_study(load, capsys):
    assert load("kill_study").main(["--kills", "2", "--seed", "1"]) == 0
    out = capsys.readouterr().out
    assert "0 differences" in out
    assert "| killed | processes |" in out


def test_many_seeds_against_single_runs(load, capsys):
    load("bench_seeds").main(["--seeds", "2", "--threads", "1", "--frames", "512", "experiment=smoke", "device=cpu"])
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith(("| 1", "| 2"))]
    assert [row[0].strip() for row in rows] == ["1", "2"]
    assert all(float(cell) > 0 for row in rows for cell in row)


def test_collection_by_workers(load, capsys):
    sizes = ["--worlds", "8", "--workers", "1", "--seconds", "0", "--repeats", "1"]
    load("bench_workers").main([*sizes, "buffer.capacity=5000", "buffer.batch_size=8"])
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines() if line.startswith("| 8")]
    assert [row[1] for row in rows] == ["no workers", "1, in turn", "1, overlap"]
    assert all(float(cell.replace(",", "")) > 0 for row in rows for cell in row[2:])


def test_training_against_torchrl(load, capsys):
    pytest.importorskip("vmas")
    sizes = ["--worlds", "8", "--steps", "2", "--repeats", "1", "--seeds", "2"]
    load("bench_training").main([*sizes, "buffer.capacity=5000", "buffer.batch_size=8"])
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in out.splitlines() if line.startswith("| ")]
    training, parts = rows[1:6], rows[7:]
    assert [row[2] for row in training[2:]] == ["ours, unfiltered", "ours, certified", "ours, certified, 2 seeds"]
    assert all(float(cell.replace(",", "")) > 0 for row in training for cell in row[3:5] + row[6:])
    assert [row[:3] for row in parts] == [["250", "3", "default"], ["100", "3", "experiment=paper"]]
    for row in parts:  # the parts are the whole
        total = sum(float(cell.split()[0]) for cell in row[4:-1])
        assert total == pytest.approx(float(row[3]), rel=0.01, abs=0.1)
