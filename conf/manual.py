"""The options as a manual: what every field is, its unit, range and default, read from the schemas' own docstrings."""

import ast
import dataclasses
import difflib
import functools
import inspect
import textwrap
import typing
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from conf.naming import GROUPS

WIDTH = 110


@functools.cache
def documentation(schema: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, in one line; nested dataclasses by dotted name.

    Args:
        schema: a dataclass whose fields are documented by a string under each.
    """
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    found: dict[str, str] = {}
    types = typing.get_type_hints(schema)
    body = typing.cast(ast.ClassDef, tree).body
    for node, following in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        name = node.target.id
        text = ""
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            text = " ".join(str(following.value.value).split())
        if dataclasses.is_dataclass(types[name]):
            nested = documentation(typing.cast(type, types[name]))
            found |= {f"{name}.{key}": value for key, value in nested.items()}
        else:
            found[name] = text
    return found


def defaults(schema: type) -> dict[str, Any]:
    """The default of every field, by dotted name."""

    def walk(values: dict[str, Any], prefix: str) -> dict[str, Any]:
        flat: dict[str, Any] = {}
        for name, value in values.items():
            nested = isinstance(value, dict) and f"{prefix}{name}" not in documentation(schema)
            flat |= walk(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
        return flat

    values = {}
    for entry in dataclasses.fields(schema):
        factory = entry.default_factory
        value = entry.default if factory is dataclasses.MISSING else factory()
        values[entry.name] = dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value  # pyright: ignore[reportArgumentType]
    return walk(values, "")


def groups(*names: str) -> str:
    """One paragraph per group: the files to choose from."""
    lines: list[str] = []
    for name in names:
        options = ", ".join(sorted(path.stem for path in (Path(__file__).parent / name).glob("*.yaml")))
        lines += textwrap.wrap(f"{name}: {options}", WIDTH, initial_indent="  ", subsequent_indent="      ")
    return "\n".join(lines)


def manual(schema: type) -> str:
    """One paragraph per option: ``name=default``, then what it is."""
    lines, group = [], ""
    start = defaults(schema)
    for name, text in documentation(schema).items():
        if "." in name and name.split(".")[0] != group:
            group = name.split(".")[0]
            lines += ["", f"{group}:"]
        lines.append(f"  {name}={_shown(start[name])}")
        lines += textwrap.wrap(text, WIDTH - 6, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(lines).replace("$", "$$")  # Hydra's template language


def explain(schema: type, key: str) -> str:
    """What is known of an option, or the names that are nearest to it."""
    known = documentation(schema)
    if key in known:
        return f"{key}: {known[key]}"
    if inside := [name for name in known if name.startswith(f"{key}.")]:
        return f"{key} is a group; its options: {', '.join(inside)}."
    candidates = known if "." in key else [*known, *_files_of(schema)]
    near = difflib.get_close_matches(key, candidates, n=3, cutoff=0.6)
    ending = [name for name in known if name.split(".")[-1] == key.split(".")[-1]]
    ending.sort(key=lambda name: difflib.SequenceMatcher(None, key, name).ratio(), reverse=True)
    guess = list(dict.fromkeys([*ending, *near]))[:4]
    return f"There is no option {key!r}." + (f" Did you mean {' or '.join(guess)}?" if guess else "")


def _files_of(schema: type) -> list[str]:
    """The groups of files that a program can choose from; those that are no part of a configuration are train.py's."""
    parts = {entry.name for entry in dataclasses.fields(schema)}
    return [name for name in GROUPS if name in parts or "train" in parts]


def check_names(cfg: DictConfig, prefix: str = "", schema: type | None = None) -> None:
    """Refuse options that were added (+name=) or deleted (~name): the first would do nothing, the second is not meant."""
    schema = schema or OmegaConf.get_type(cfg)
    known = {entry.name for entry in dataclasses.fields(OmegaConf.get_type(cfg))}
    for key in sorted({str(key) for key in cfg} ^ known):
        if key in known:
            raise ValueError(f"~{prefix}{key}: options cannot be deleted; leave it out for its default.")
        raise ValueError(explain(schema, f"{prefix}{key}") + " python <program> --help lists all options.")
    for key in cfg:
        if OmegaConf.is_dict(value := cfg._get_node(key)) and dataclasses.is_dataclass(OmegaConf.get_type(value)):
            check_names(value, f"{prefix}{key}.", schema)  # pyright: ignore[reportArgumentType]


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value).replace(" ", "")
