"""Shared fixtures: run the Hydra programs in this process, in an empty folder."""

import gc
import sys

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    torch.set_num_threads(1)
    gc.freeze()  # what is imported stays: searching it again and again is a fifth of a Hydra program's time
    gc.set_threshold(50_000, 20, 50)


def call(main, *arguments):
    """Exit code of a program that runs in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["program", *arguments])
        try:
            main()
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else 1
    return 0


@pytest.fixture
def program(monkeypatch, tmp_path, capfd):
    """``program(main, *arguments) -> (exit code, stdout + stderr)``, with an empty folder as working directory."""
    monkeypatch.chdir(tmp_path)

    def run(main, *arguments):
        code = call(main, *arguments)
        out, err = capfd.readouterr()
        return code, out + err

    return run
