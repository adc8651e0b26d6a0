"""Studies of Optuna that go on: what their storage holds, and trials that were killed."""

import warnings
from pathlib import Path

from omegaconf import DictConfig, read_write

PREFIX = "sqlite:///"


def go_on(sweeper: DictConfig) -> None:
    """Let a study that is kept in a file go on.

    Its ``n_trials`` becomes the number that is left of it; the trials that a kill left unfinished come first; the sampler takes
    another seed, or it would repeat itself. The folder of the file is made.

    Args:
        sweeper: the settings hydra.sweeper; those of another sweeper than Optuna's, or without a file, are left alone.
    """
    storage = str(sweeper.get("storage"))
    if not storage.startswith(PREFIX):
        return
    path = Path(storage.removeprefix(PREFIX))
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file():
        return
    import optuna  # pyright: ignore[reportMissingImports]

    try:
        study = optuna.load_study(study_name=str(sweeper.study_name), storage=storage)
    except KeyError:  # the file holds other studies
        return
    trials = study.trials
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # enqueue_trial is one in Optuna 2
        for trial in trials:
            if not trial.state.is_finished() and trial.params:
                study.tell(trial.number, state=type(trial.state).FAIL)
                study.enqueue_trial(trial.params)
    # a trial that is made again counts once
    ended = {repr(sorted(trial.params.items())) for trial in trials if trial.state.is_finished()}
    with read_write(sweeper):
        sweeper.n_trials = max(0, sweeper.n_trials - len(ended))
        if sweeper.sampler.get("seed") is not None:
            sweeper.sampler.seed += len(trials)
