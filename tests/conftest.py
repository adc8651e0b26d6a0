"""Shared fixtures: run the Hydra programs in this process, in an empty folder."""

import sys

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def program(monkeypatch, tmp_path, capfd):
    """``program(main, *arguments) -> (exit code, stdout + stderr)``, with an empty folder as working directory."""
    monkeypatch.chdir(tmp_path)

    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["program", *arguments])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        out, err = capfd.readouterr()
        return code, out + err

    return run
