"""The layout: imports go one way, files stay small, no shortcuts."""

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("envs", "safety", "agents", "conf")
TOP = ("train", "evaluate", "report")
# importer: what it may not import of this project
FORBIDDEN = {
    "envs": {"safety", "agents", "conf", *TOP},
    "safety": {"agents", "conf", *TOP},
    "agents": {"conf", *TOP},
    "conf": set(TOP),
}
MAX_LINES = 360


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(), str(path))


def files(*packages):
    found = [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]
    assert found
    return found


def imports(path):
    """Modules that a file imports, wherever in it, with relative imports resolved."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("__import__", "importlib.import_module"):
            yield ast.literal_eval(node.args[0])


def roots(path):
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_go_one_way(package):
    for path in files(package):
        assert not roots(path) & FORBIDDEN[package], path


def test_the_arrows_exist():
    # guards against a test that looks at nothing
    assert any("envs" in roots(path) for path in files("safety"))
    assert any("safety" in roots(path) for path in files("agents"))
    assert "agents" in roots(ROOT / "train.py")
    assert {"envs", "agents"} <= roots(ROOT / "evaluate.py")


def test_only_the_solver_imports_qpth():
    users = [path.relative_to(ROOT).as_posix() for path in [*files(*PACKAGES), *top_files()] if "qpth" in roots(path)]
    assert users == ["safety/qp.py"]


def test_metrics_know_nothing_of_the_filter():
    assert not any(name.startswith("safety") for name in imports(ROOT / "envs/metrics.py"))
    # and nothing that they import does either
    seen, todo = set(), ["envs.metrics"]
    while todo:
        name = todo.pop()
        path = ROOT / (name.replace(".", "/") + ".py")
        path = path if path.is_file() else ROOT / name.replace(".", "/") / "__init__.py"
        if name not in seen and path.is_file():
            seen.add(name)
            assert not any(module.split(".")[0] == "safety" for module in imports(path)), path
            todo += imports(path)
    assert "envs.config" in seen


@pytest.mark.parametrize("name", ["benchmarks", "scripts", "setup"])
def test_names_that_wheels_install_are_not_used(name):
    assert not (ROOT / name).exists()
    assert not (ROOT / f"{name}.py").exists()


def top_files():
    return [ROOT / f"{name}.py" for name in TOP]


def test_files_are_short():
    for path in files(*PACKAGES):
        name = path.relative_to(ROOT).as_posix()
        assert len(path.read_text().splitlines()) <= MAX_LINES, name
    assert len((ROOT / "train.py").read_text().splitlines()) <= 170


def test_no_shortcuts():
    for path in [*files(*PACKAGES), *top_files()]:
        for node in ast.walk(parsed(path)):
            where = f"{path}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.ExceptHandler):
                assert node.type is not None, f"bare except, {where}"
            if isinstance(node, ast.ImportFrom):
                assert all(alias.name != "*" for alias in node.names), f"import *, {where}"
            if isinstance(node, ast.Call) and path.name != "evaluate.py":
                assert ast.unparse(node.func) != "print", f"print, {where}"


def test_no_device_is_named_in_world_and_filter():
    for path in files("envs", "safety"):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.fullmatch(r"cuda(:\d+)?", node.value), f"{path}:{node.lineno}"
            if isinstance(node, ast.Attribute):
                assert node.attr != "cuda" or ast.unparse(node) == "torch.cuda", f"{path}:{node.lineno}"


def test_every_package_says_what_it_is_for():
    for path in [*files(*PACKAGES), *top_files()]:
        assert ast.get_docstring(parsed(path)), path
