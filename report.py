"""Compare the runs of a sweep: tables and learning curves with confidence intervals over the seeds.

``python report.py sweep=<folder>`` writes ``<folder>/report/``; ``python report.py --help`` says what and from what, and how
a sweep outlives its machine.
"""

import logging
import tempfile
from pathlib import Path

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from agents.report_archive import pack_runs, unpack_runs
from agents.report_figures import save_figures
from agents.report_runs import check_runs, find_runs, read_events
from agents.report_statistics import LOGGED, Bootstrap, Groups, compute_curves, compute_rows
from agents.report_tables import Report, find_method, write_curves, write_rows, write_runs
from conf.callbacks import one_clear_error
from conf.command_line import clear_errors
from conf.naming import config_hash
from conf.report_schema import ReportConfig
from conf.schema import register, to_config

register()
logging.getLogger("tensorboard").setLevel(logging.ERROR)

FILES = ("report.md", "table.csv", "runs.csv", "curves.csv", "curves.png", "curves.svg", "rates.png", "rates.svg")


@clear_errors(ReportConfig)
@hydra.main(version_base="1.3", config_path="conf", config_name="report")
@one_clear_error
def main(cfg: DictConfig) -> None:
    """One report, or the unpacking of an archive of runs."""
    config: ReportConfig = to_config(cfg)
    sweep = Path(config.sweep or "").expanduser()
    if config.unpack is not None:
        tqdm.write(unpack_runs(Path(config.unpack).expanduser(), sweep))
        return
    runs, warnings = check_runs(find_runs(sweep, config_hash), incomplete=config.incomplete)
    groups, bootstrap = Groups(runs), Bootstrap(config.resamples, config.confidence, config.seed)
    reference = find_method(groups, config.reference, "reference")
    against = find_method(groups, config.against, "against")
    rows = compute_rows(groups, bootstrap, reference)
    learned = [run for run in runs if run.learned]
    events = {  # files with pictures take about half a second each
        run.name: read_events(run.folder, LOGGED.values()) for run in tqdm(learned, unit="run", disable=None)
    }
    curves, unlogged = compute_curves(groups, bootstrap, lambda run: events[run.name].curves())
    warnings += unlogged
    report = Report(groups, rows, reference, against)

    target = sweep / "report"
    # a report that fails leaves the old one
    with tempfile.TemporaryDirectory(prefix=".report_", dir=sweep) as temporary:
        folder = Path(temporary)
        figures = save_figures(groups, rows, curves, report.compared, folder)
        write_rows(folder / "table.csv", rows)
        write_runs(folder / "runs.csv", runs)
        write_curves(folder / "curves.csv", curves)
        text = report.markdown(sweep.resolve().name, warnings, bootstrap, figures)
        (folder / "report.md").write_text(text, encoding="utf-8")
        target.mkdir(exist_ok=True)
        for name in FILES:
            if (folder / name).exists():
                (folder / name).replace(target / name)
            else:
                (target / name).unlink(missing_ok=True)
    tqdm.write("".join(f"warning: {line}\n" for line in warnings) + str(target / "report.md"))
    if config.pack is not None:
        tqdm.write(pack_runs(runs, events, Path(config.pack).expanduser()))


if __name__ == "__main__":
    main()
