"""What a command costs: wall time with a cold start, peak memory, and on which machine."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from relit.errors import EXIT_FAILED, UserError

COST_DEFINITIONS = {
    "seconds": (
        "s",
        "wall time of the whole command `relit reconstruct`, from its start to its exit, with an empty cache of compiled kernels",
    ),
    "peak_memory": (
        "GB",
        "largest resident set of any one process of the command, as the system reports when it has ended (10^9 bytes)",
    ),
}

# A process that is started from a large one is charged with that one's memory up to its exec (Linux
# keeps it in ru_maxrss), and this one has rendered before. So a small one starts the command and
# reads its peak.
LAUNCHER = """
import json, os, subprocess, sys, time
start = time.perf_counter()
process = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
seconds = time.perf_counter() - start
with open(sys.argv[1], "w") as file:
    json.dump([seconds, os.waitstatus_to_exitcode(status), usage.ru_maxrss], file)
"""


def timed(command: Sequence[str], log: Path) -> tuple[float, float]:
    """Run a command with its output in `log` and no compiled kernels at hand; (seconds, peak memory
    in GB).

    Raises UserError (exit code 4) with the end of its output when it fails. The peak is `ru_maxrss`
    of the command and all that it waited for.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    usage = log.with_suffix(".usage.json")
    usage.unlink(missing_ok=True)
    with log.open("wb") as file, tempfile.TemporaryDirectory() as kernels:
        environment = {
            **os.environ,
            "DRJIT_CACHE_DIR": kernels,
        }  # empty: compiled kernels of earlier runs would hide the cold start
        launch = [sys.executable, "-S", "-E", "-c", LAUNCHER, str(usage), *command]
        subprocess.run(
            launch,
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            check=False,
            env=environment,
        )
    if not usage.exists():
        raise UserError(
            "the command was stopped before it could be measured",
            fix=f"its output: {log}",
            code=EXIT_FAILED,
        )
    seconds, code, peak = json.loads(usage.read_text())
    if code != 0:
        tail = log.read_text(errors="replace").strip().splitlines()[-12:]
        raise UserError(
            f"the command ended with code {code}",
            "\n".join(tail),
            f"its whole output: {log}",
            code=EXIT_FAILED,
        )
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes there, KiB on Linux
    return seconds, peak * unit / 1e9


def machine() -> str:
    """Processor, cores this process may use, memory, Python: what a time is worth."""
    name = platform.processor() or platform.machine()
    try:
        info = Path("/proc/cpuinfo").read_text()
        name = next(
            (
                line.split(":", 1)[1].strip()
                for line in info.splitlines()
                if line.startswith("model name")
            ),
            name,
        )
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1e9:.0f} GB"
    except (OSError, ValueError):
        memory = ""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores{memory}, Python {platform.python_version()}"
