"""Whether a Ray cluster answers."""

import re
import socket
import subprocess
import sys

REACH_SECONDS = 5.0
"""How long the head node of a Ray cluster may take to answer."""


def reach_ray(address: str, option: str) -> None:
    """Refuse a Ray cluster that does not answer; Ray itself would try for minutes.

    Args:
        address: ``<host>:<port>``, also with ray:// before it, ``auto``, or ``local`` for one that is yet to start.
        option: that names it, for the message.

    Raises:
        ConnectionError: saying why, and what to do.
    """
    found = re.fullmatch(r"(ray://)?(\[[^]]+\]|[^:/]+):(\d+)", address)
    if address != "auto" and not found:
        return
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check"]
    why = None
    try:
        if found is None:
            missing = subprocess.run(check, timeout=4 * REACH_SECONDS, capture_output=True, check=False).returncode
            why = "none runs on this machine" if missing else None
        else:
            host, port = found.group(2).strip("[]"), int(found.group(3))
            socket.create_connection((host, port), timeout=REACH_SECONDS).close()
            # Somebody answers: is it Ray? Whatever the check finds, it finds at once; what is no Ray keeps it waiting.
            if not found.group(1):
                check += ["--address", f"{host}:{port}"]
                subprocess.run(check, timeout=4 * REACH_SECONDS, capture_output=True, check=False)
    except (OSError, OverflowError) as error:
        why = str(error)
    except subprocess.TimeoutExpired:
        why = "no Ray there"
    if why:
        raise ConnectionError(
            f"the Ray cluster at {address.removeprefix('ray://')} does not answer ({why}). Start its head node (ray start --head), "
            f"correct {option}, or leave it out for a cluster on this machine. Nothing was started."
        )
