"""Peak memory of writing an MP4, against its length: each length in a process of its own (Linux).

``python tests/benchmarks/video_memory.py 300 3000``: lengths in frames.
"""

import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the programs are run as files

from envs.video import save_mp4
from tests.test_rendering import make


def watch_encoder(peak: list[int], done: threading.Event) -> None:
    """Keep the largest peak (kB) of the child processes; the kernel's own figure counts the moment of their fork."""
    while not done.wait(0.05):
        for task in Path("/proc/self/task").iterdir():
            for child in (task / "children").read_text().split():
                try:
                    status = Path(f"/proc/{child}/status").read_text()
                except OSError:  # it has ended
                    continue
                lines = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
                if "ffmpeg" in lines["Name"] and "VmHWM" in lines:
                    peak[0] = max(peak[0], int(lines["VmHWM"].split()[0]))


def measure(frames: int) -> None:
    """Write one video of synthetic robots and print what it took."""
    world, peak, done = make(3, 2, steps=frames), [0], threading.Event()
    watcher = threading.Thread(target=watch_encoder, args=(peak, done))
    watcher.start()
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as folder:
        size = save_mp4(world, Path(folder) / "world.mp4").stat().st_size
    seconds = time.perf_counter() - start
    done.set()
    watcher.join()
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{frames} frames: peak {here / 1024:.0f} MB, {(here - before) / 1024:.0f} MB more than before; encoder "
        f"{peak[0] / 1024:.0f} MB; {frames / seconds:.0f} frames/s, file {size / 2**20:.1f} MB"
    )


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        measure(int(sys.argv[2]))
    else:
        for count in sys.argv[1:]:
            subprocess.run([sys.executable, __file__, "--one", count], check=True)
