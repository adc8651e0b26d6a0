"""Errors of the command line in a few lines, in place of Hydra's: what is wrong, what is allowed, what to do."""

import contextlib
import functools
import os
import re
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from hydra._internal import utils as hydra_utils
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from conf.launching import missing_plugin
from conf.manual import explain
from conf.sweep import checked_sweeps
from conf.sweep_jobs import FAILED_JOBS

FULL = "HYDRA_FULL_ERROR"
QUOTING = (
    "An override is name=value, or group=option; values with spaces, commas, = or brackets need quotes for Hydra inside quotes "
    "for the shell: 'name=\"a value\"'. python <program> --help lists the options."
)
BROKEN_PIPE = 141  # 128 + SIGPIPE, as a shell has it
ENTRY = {"command_line.py", "sweep.py", "train.py", "evaluate.py", "report.py"}


def _wrapped(text: str) -> Iterator[str]:
    """Lines of the text; paths stay in one piece, to be copied, unless they are absurd."""
    for line in textwrap.wrap(text, 110, break_on_hyphens=False, break_long_words=False):
        yield from [line] if "/" in line and len(line) < 256 else textwrap.wrap(line, 110)


def wants_traceback() -> bool:
    """Whether the user asked for Hydra's own errors."""
    return os.environ.get(FULL) == "1"


def fail(error: BaseException | str) -> None:
    """Print one message of at most 8 lines and leave with exit code 1."""
    text = str(error).splitlines() or [type(error).__name__]
    lines = [line for part in text for line in _wrapped(part)][:7]
    sys.stderr.write("\n".join(["error: " + lines[0], *("  " + line for line in lines[1:])]) + "\n")
    sys.exit(1)


def clear_errors(schema: type) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Decorator of a program with Hydra's: its composition errors are explained, failed jobs listed at a sweep's end.

    ``HYDRA_FULL_ERROR=1`` leaves everything to Hydra.

    Args:
        schema: the program's configuration, whose documentation the messages quote.
    """

    def decorate(main: Callable[[], None]) -> Callable[[], None]:
        @functools.wraps(main)
        def wrapper() -> None:
            if wants_traceback():
                with checked_sweeps():
                    main()
            else:
                _check_flags()
                with _raising(), checked_sweeps():
                    _explain(main, schema)
            if FAILED_JOBS:
                list_failures()

        return wrapper

    return decorate


def _explain(main: Callable[[], None], schema: type) -> None:
    """Run ``main``; what Hydra refuses ends in one message, a reader that has read enough (head) in none."""
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:
        # the interpreter would complain of what is left to write
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(BROKEN_PIPE)
    except (HydraException, OmegaConfBaseException) as error:
        if not FAILED_JOBS:
            fail(describe(error, schema))
    except Exception as error:
        if not FAILED_JOBS and not _is_hydras(error):  # a programming error of this project
            raise
        if not FAILED_JOBS:
            fail(f"Hydra cannot combine these overrides ({type(error).__name__}: {error}). {QUOTING}")


@contextlib.contextmanager
def _raising() -> Iterator[None]:
    """Hydra raises its errors instead of printing them."""
    before = hydra_utils.run_and_report
    hydra_utils.run_and_report = lambda func: func()
    try:
        yield
    finally:
        hydra_utils.run_and_report = before


def _is_hydras(error: BaseException) -> bool:
    """Whether an error comes out of Hydra, before any code of this project but its entry."""
    root = Path(__file__).resolve().parents[1]
    frames = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    own = [path for path in frames if root in path.parents and "site-packages" not in path.parts]
    return {path.parent for path in own} <= {root, Path(__file__).parent} and not {path.name for path in own} - ENTRY


def _check_flags() -> None:
    """Refuse what begins with a dash and is no flag of Hydra's, which would print a page."""
    parser = hydra_utils.get_args_parser()
    parser.error = lambda message: fail(f"{message}. {QUOTING}")  # pyright: ignore[reportAttributeAccessIssue]
    _, unknown = parser.parse_known_args()
    if unknown:
        fail(f"{unknown[0]!r} is neither a flag nor an override. {QUOTING}")


def list_failures() -> None:
    """Name the failed jobs of a multirun, one after the other, with their logs, and leave with exit code 1."""
    sys.stderr.write(f"error: {len(FAILED_JOBS)} of the sweep's runs failed; the others are complete:\n")
    for job in FAILED_JOBS:
        first = " ".join(str(job.error).split()) or type(job.error).__name__
        where = f" [{job.log}]" if job.log else ""
        sys.stderr.write(f"  {' '.join(job.overrides)}: {textwrap.shorten(first, 300)}{where}\n")
    sys.exit(1)


def describe(error: BaseException, schema: type) -> str:
    """What Hydra or OmegaConf complain about, with what the schema says of the option."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else None
    text, why = str(error), str(cause or error).splitlines()[0] if str(cause or error) else type(error).__name__
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} is not an override: {' '.join(str(error).split('See https')[0].split())}\n{QUOTING}"
    if isinstance(error, MissingConfigException):
        if message := missing_plugin(str(error.missing_cfg_file).removesuffix(".yaml")):
            return message
        listed = [line.strip() for line in text.split("Available options in")[-1].splitlines()[1:]]
        options = [name for name in listed if re.fullmatch(r"[\w-]+", name)]
        named = re.search(r"'([^']+/[^']+|[^']+)'(?=\s*$|\n)", text.splitlines()[0])
        group, _, option = (error.missing_cfg_file or (named.group(1) if named else "")).rpartition("/")
        known = f" Choose one of {', '.join(options)}." if options else ""
        return f"{group}={option}: group {group} has no option {option!r}.{known}"
    if match := re.match(r"Error merging override (.+)", text):
        override = match.group(1)
        key = getattr(cause, "full_key", None) or override.split("=")[0].lstrip("+~")
        return f"{override}: {why}.\n{explain(schema, str(key).split('[')[0])}"
    if match := re.match(r"Could not (?:override|append to config|delete from config)\.? ?'?([^'\s]*)", text):
        # the cause may name its group only
        key = max(match.group(1), str(getattr(cause, "full_key", None) or ""), key=len)
        return f"{why.rstrip('.')}.\n{explain(schema, key)} python <program> --help lists all options."
    if isinstance(error, ConfigCompositionException | OmegaConfBaseException):
        key = str(getattr(cause or error, "full_key", None) or "hydra")
        return text if key.startswith("hydra") else f"{why}\n{explain(schema, key)}"
    return " ".join(text.split())
