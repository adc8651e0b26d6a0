"""Table of a safety study: ``python tests/benchmarks/safety_table.py <folder>`` reads every evaluation under the folder.

One row per layout, number of robots, controller and filter (or summed over the controllers with ``--sum``), as Markdown.
A certified evaluation stops at a violation and leaves violation.json instead of eval.json: such jobs and unfinished ones are
named, and the program fails.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path

COLUMNS = (
    "robot-steps",
    "depleted",
    "stranded",
    "overcharged",
    "collision",
    "infeasible",
    "outside",
    "hold %",
    "homing %",
)
FILES = ("eval.json", "violation.json")
MARGINS = ("E margin", "distance margin m", "way-points / 1000")


def layout(env: dict) -> str:
    """Name of a world of the study by what distinguishes it."""
    names = {0: "perimeter", 1: "ring", 8: "interior"}
    name = "aerial" if env["dimension"] == 3 else names.get(len(env["stations"]), f"{len(env['stations'])} stations")
    extras = [f"dt={env['dt']}"] * (env["dt"] != 0.2) + ["fixed slots"] * (not env["reassign_slots"])
    extras += [env["reserve"]] * (env["reserve"] != "linear") + [env["dtype"]] * (env["dtype"] != "float32")
    return " ".join([name, *extras])


def filter_name(safety: dict) -> str:
    """Name of a filter by its configuration group."""
    changes = [safety[name] for name in ("split", "solver") if safety[name] not in ("auto", "anchor", "exact")]
    if safety["mode"] == "certified":
        return " ".join(["certified", *changes])
    if safety["mode"] == "none":
        return "none"
    if safety["composition"] == "min":
        return "paper"
    return safety["split"] if safety["split"] == "joint" else "stacked" if safety["sampled_data"] else "half"


def main() -> None:
    """Print the table."""
    arguments = [a for a in sys.argv[1:] if not a.startswith("--")]
    folder, total = Path(arguments[0]), "--sum" in sys.argv
    rows: dict[tuple, list[dict]] = defaultdict(list)
    for path in sorted(folder.rglob("eval.json")):
        content = json.loads(path.read_text())
        name = "all" if total else content["policy"]
        key = (layout(content["env"]), content["env"]["n_agents"], name, filter_name(content["safety"]))
        rows[key].append(content)
    header = ("layout", "N", "controller", "filter", *COLUMNS, *MARGINS)
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    steps = 0
    for key, contents in sorted(rows.items()):
        count = sum(c["robot_steps"] for c in contents)
        steps += count

        def summed(*names: str, of: list[dict] = contents) -> float:
            total = 0.0
            for content in of:
                value = content
                for name in names:
                    value = value.get(name, 0)
                total += value
            return total

        def share(name: str, of: list[dict] = contents, count: int = count) -> float:
            return 100 * sum(c["filter"][name] * c["robot_steps"] for c in of) / count

        violations = [
            f"{summed('violations', kind):.0f}" for kind in ("depleted", "stranded", "overcharged", "collision")
        ]
        homing = share("homing_rate")
        energies = [c["min_energy_margin"] for c in contents]
        energy = (
            "NaN" if None in energies else f"{min(energies):.5f}"
        )  # an unfiltered NaN action drains the battery to NaN
        distances = [c["min_distance_margin"] for c in contents if c["min_distance_margin"] is not None]
        points, patrolled = summed("task", "waypoints"), sum(c["robot_steps"] for c in contents if c["task"])
        cells = (
            *(key[0], str(key[1]), key[2], key[3], f"{count:,}", *violations),
            *(f"{summed('filter', 'infeasible'):.0f}", f"{summed('filter', 'outside'):.0f}"),
            *(f"{share('fallback_rate') - homing:.3f}", f"{homing:.4f}", energy),
            *(f"{min(distances):.4f}" if distances else "–", f"{1000 * points / patrolled:.1f}" if patrolled else "–"),
        )
        lines.append("| " + " | ".join(cells) + " |")
    sys.stdout.write("\n".join(lines) + f"\n\n{steps:,} robot-steps\n")
    violated = sorted(folder.rglob("violation.json"))
    unfinished = [p.parent for p in folder.rglob(".hydra") if not any((p.parent / f).is_file() for f in FILES)]
    for path in violated:
        sys.stdout.write(f"VIOLATION behind the certified filter: {path} {json.loads(path.read_text())['kinds']}\n")
    for path in sorted(unfinished):
        sys.stdout.write(f"unfinished: {path}\n")
    sys.exit(1 if violated or unfinished else 0)


if __name__ == "__main__":
    main()
