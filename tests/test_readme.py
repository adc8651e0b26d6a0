"""The README's Python runs as it is printed."""

import re
import textwrap
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def python_of(section):
    """The indented block of a section, the only one in it."""
    text = README.read_text(encoding="utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    (block,) = re.findall(r"(?:^ {4}.*\n|^\n(?= {4}))+", text, flags=re.MULTILINE)
    return textwrap.dedent(block)


def test_the_filter_around_ones_own_controller_runs_and_keeps_its_promise(capsys):
    names = {}
    exec(compile(python_of("From Python"), str(README), "exec"), names)
    world, rollout = names["world"], names["rollout"]
    assert rollout.shape == (4, 250)
    assert rollout["agents", "action"].shape == (4, 250, world.n_agents, world.dimension)
    assert names["violations"] == dict.fromkeys(("depleted", "stranded", "overcharged", "collision"), 0)
    assert not any(flags.any() for flags in rollout["next", "agents", "violation"].values())
    assert 0.5 < names["corrected"] < 1  # the filter had something to do
    assert capsys.readouterr().out.startswith(f"{names['violations']} ")
