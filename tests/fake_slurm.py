#!/usr/bin/env python
"""A Slurm of one machine, for tests: ``install(folder)`` makes sbatch, srun, scontrol and sacct there.

sbatch reads a job array's script, prints the job's number, and runs the tasks one after the other in the background; scontrol
requeue makes it run a task again when the task has ended, as Slurm does.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

JOB = "4242"


def install(folder):
    folder.mkdir()
    for name in ("sbatch", "srun", "scontrol", "sacct"):
        program = folder / name
        program.write_text(f'#!/bin/sh\nFAKE_SLURM={folder} exec {sys.executable} {__file__} {name} "$@"\n')
        program.chmod(0o755)


def run_tasks(script):
    folder = Path(os.environ["FAKE_SLURM"])
    first, last = re.search(r"--array=(\d+)-(\d+)", Path(script).read_text()).groups()
    for task in range(int(first), int(last) + 1):
        names = {"SLURM_JOB_ID": f"{int(JOB) + task}", "SLURM_ARRAY_JOB_ID": JOB, "SLURM_ARRAY_TASK_ID": str(task)}
        again = folder / f"requeue_{JOB}_{task}"
        while True:
            subprocess.run(["bash", script], env=os.environ | names, check=False)
            if not again.exists():
                break
            again.rename(folder / f"requeued_{JOB}_{task}")
    (folder / "all_done").touch()


def main(program, *arguments):
    folder = Path(os.environ["FAKE_SLURM"])
    if program == "sbatch":
        (folder / "script").write_text(Path(arguments[-1]).read_text())  # submitit moves its own
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.Popen([sys.executable, __file__, "tasks", str(folder / "script")], start_new_session=True, **quiet)
        sys.stdout.write(f"Submitted batch job {JOB}\n")
    elif program == "tasks":
        run_tasks(*arguments)
    elif program == "srun":
        task = f"{JOB}_{os.environ['SLURM_ARRAY_TASK_ID']}"
        output = (
            arguments[arguments.index("--output") + 1].replace("%A_%a", task).replace("%j", task).replace("%t", "0")
        )
        with open(output, "a") as file:
            command = list(arguments[arguments.index("--output") + 2 :])
            sys.exit(subprocess.run(command, stdout=file, stderr=file, check=False).returncode)
    elif program == "scontrol":
        (folder / f"requeue_{arguments[-1]}").touch()
    elif program == "sacct":
        state = "COMPLETED" if (folder / "all_done").exists() else "RUNNING"
        sys.stdout.write("JobID|State|NodeList\n" + "".join(f"{JOB}_{task}|{state}|here\n" for task in range(8)))


if __name__ == "__main__":
    main(*sys.argv[1:])
