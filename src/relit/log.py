"""Log lines, progress lines and memory use of a job.

All output goes to stderr, so that a command's result on stdout can be piped.
"""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

REDRAW_SECONDS = 0.2  # a terminal's progress line
PLAIN_SECONDS = 10.0  # a progress line in a file or a pipe


class Log:
    """Log lines, written to `stream` unchanged and to the file `path` with a time stamp.

    Not safe to share between processes. The file is opened for each line, so it may be moved or
    read at any time.
    """

    def __init__(self, path: Path | None = None, stream: TextIO | None = None):
        self.path, self._stream, self._drawn = path, stream, 0

    @property
    def stream(self) -> TextIO:
        return self._stream or sys.stderr

    def say(self, text: str) -> None:
        """One log line, on the stream and in the file."""
        self.clear()
        print(text, file=self.stream, flush=True)
        self.note(text)

    def note(self, text: str) -> None:
        """One line in the file only."""
        if self.path is not None:
            stamp = time.strftime("%Y-%m-%d %H:%M:%S")
            with self.path.open("a", encoding="utf-8") as file:
                file.write("".join(f"{stamp}  {line}\n" for line in text.splitlines() or [""]))

    def draw(self, text: str) -> None:
        """Overwrite the terminal's progress line with `text`."""
        print("\r" + text.ljust(self._drawn), end="", file=self.stream, flush=True)
        self._drawn = len(text)

    def clear(self) -> None:
        """Erase the progress line."""
        if self._drawn:
            print("\r" + " " * self._drawn + "\r", end="", file=self.stream, flush=True)
            self._drawn = 0


class Progress:
    """Stage, step, rate and time left: one line that is redrawn on a terminal, a new line every
    10 s otherwise.

    title: name of the stage. steps: their total number, or None if unknown.
    """

    def __init__(self, log: Log, title: str, steps: int | None):
        self.log, self.title, self.steps = log, title, steps
        self.tty = bool(getattr(log.stream, "isatty", lambda: False)())
        self._first: tuple[float, int] | None = None
        self._window: tuple[float, int] = (time.monotonic(), 0)
        self._rate: float | None = None  # steps per second
        self._shown = time.monotonic()

    def update(self, done: int, values: dict[str, float] | None = None) -> None:
        """done: steps completed so far, including those before a resume."""
        now = time.monotonic()
        if self._first is None:
            self._first = self._window = (now, done)
        if (
            now - self._shown < (REDRAW_SECONDS if self.tty else PLAIN_SECONDS)
            and done != self.steps
        ):
            return
        self._measure(now, done)
        self._shown = now
        text = self._text(done, values or {})
        if self.tty:
            self.log.draw(text)
        else:
            self.log.say(text)

    def _measure(self, now: float, done: int) -> None:
        since, at = self._window
        if done > at and now - since > 0.5:
            rate = (done - at) / (now - since)
            self._rate = rate if self._rate is None else 0.7 * self._rate + 0.3 * rate
            self._window = (now, done)

    def _text(self, done: int, values: dict[str, float]) -> str:
        parts = [self.title, f"{done}/{self.steps}" if self.steps else str(done)]
        if self.steps:
            parts.append(f"{100 * done // self.steps} %")
        if self._rate:
            parts.append(
                f"{self._rate:.1f}/s" if self._rate >= 1 else f"{1 / self._rate:.1f} s/step"
            )
            if self.steps and done < self.steps:
                parts.append(f"{readable_seconds((self.steps - done) / self._rate)} left")
        parts += [f"{name} {value:.4g}" for name, value in values.items()]
        return "  ".join(parts)


@contextmanager
def counted(title: str) -> Generator[Callable[[int, int], None], None, None]:
    """A progress line as a function of (done, total); the total may change."""
    progress = Progress(Log(), title, None)

    def show(done: int, count: int) -> None:
        progress.steps = count
        progress.update(done)

    yield show
    progress.log.clear()


def readable_seconds(seconds: float) -> str:
    """'8 s', '3 min 20 s', '2 h 5 min'."""
    s = round(seconds)
    if s < 60:
        return f"{s} s"
    return f"{s // 60} min {s % 60} s" if s < 3600 else f"{s // 3600} h {s % 3600 // 60} min"


def readable_bytes(count: float) -> str:
    """'812 MB', '3.4 GB' (powers of 1000)."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def peak_memory() -> int:
    """Largest resident set of this process so far, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def available_memory() -> int | None:
    """Bytes available without swapping, within the container's limit, or None if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    free = next(
        (int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None
    )
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
    except (OSError, ValueError):
        return free
    return free if limit == "max" or free is None else min(free, int(limit) - used)


class MemoryWatch:
    """Peak resident memory between `start()` and `stop()`, bytes, by sampling twice a second.

    A new maximum of the process is exact (recorded by the kernel); a stage below an earlier maximum
    is sampled.
    """

    def start(self) -> MemoryWatch:
        self._before, self._peak, self._end = peak_memory(), _resident(), threading.Event()
        self._thread = threading.Thread(target=self._sample, name="relit-memory", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> int:
        self._end.set()
        self._thread.join()
        after = peak_memory()
        return after if after > self._before else max(self._peak, _resident())

    def _sample(self) -> None:
        while not self._end.wait(0.5):
            self._peak = max(self._peak, _resident())


def _resident() -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except (OSError, IndexError):  # no /proc: the maximum so far is an upper bound
        return peak_memory()
