"""A run folder: what a long job leaves behind, and how it goes on after it was stopped.

RUN/ config.toml  inputs.json  log.txt  metrics.jsonl  stages/<name>/{DONE, *.npz}  previews/*.jpg
`DONE` is written last, so a stage either is complete or is taken up again from its newest
checkpoint. Nothing in the folder is an absolute path. One process at a time holds the folder; the
kernel drops the lock when that process dies.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import shutil
import signal
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from relit.errors import EXIT_ENVIRONMENT, EXIT_FAILED, EXIT_USAGE, UserError
from relit.files import (
    NO_ARRAYS,
    disk_errors,
    load_arrays,
    parse_toml,
    read_json,
    save_arrays,
    toml_text,
    write_text,
)
from relit.log import Log, MemoryWatch, Progress, readable_bytes, readable_seconds
from relit.records import from_arrays, to_arrays

T = TypeVar("T")

CHECKPOINT_SECONDS = (
    20.0  # a checkpoint is due this long after the last one, later if writing one is slow
)
CHECKPOINT_LONGEST = 60.0  # ... but never later than this
PREVIEW_SECONDS = 10.0  # between two previews of a stage
METRICS_SECONDS = 0.5  # between two lines of metrics.jsonl
FILES = ("config.toml", "inputs.json", "evaluation.json", "log.txt", "metrics.jsonl", "report.html")
RUN_FORMAT = 3  # of the stages' results; a run folder of another format is refused
OWNED = (*FILES, "stages", "previews", "photos", "asset")


class StageReached(Exception):
    """The stage after which a run was to stop (`Run.until`) has ended."""


class Terminated(BaseException):
    """SIGTERM, raised in the main thread so that files are closed and the lock is dropped."""


STOPS: dict[int, type[BaseException]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
}


class Run:
    """One run folder, held by this process. Make it with `Run.open`; it is a context manager.

    force: keep a result that its own evidence does not bear out, see `refuse`. until: name of the
    stage to stop after, '' for none.
    """

    def __init__(self, folder: Path, config: dict, lock: int, log: Log):
        self.folder, self.config, self.log = folder, config, log
        self.force, self.until = False, ""
        self._unlock = weakref.finalize(self, os.close, lock)

    @staticmethod
    def open(
        folder: str | Path,
        config: dict,
        *,
        resume: bool = True,
        inputs: dict[str, str] | None = None,
    ) -> Run:
        """Make the run folder, or take it up again.

        config: what decides the result; strings, numbers, booleans, lists and one level of tables
        (saved as config.toml).
        inputs: {name: digest} from `digests`; a file that changed since the run was begun is an
        error.
        resume: False removes what an earlier run left in the folder (only files that a run makes).
        Raises UserError when the folder holds something else, another process has it, or its
        settings or inputs differ.
        """
        folder = Path(folder)
        config = {"run_format": RUN_FORMAT, **config}
        wanted = parse_toml(toml_text(config))
        with disk_errors(folder):
            _refuse_foreign(folder)
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except (
                FileNotFoundError,
                NotADirectoryError,
                FileExistsError,
            ) as error:  # below a file, or in /proc
                what = f"the output folder cannot be made: {error.strerror}"
                raise UserError(
                    what, fix=f"choose another -o: {folder}", code=EXIT_ENVIRONMENT
                ) from None
            lock = _lock(folder)
            try:
                if not resume:
                    _remove_owned(folder)
                _compare(folder, wanted, inputs)
                if not (folder / "config.toml").exists():
                    write_text(folder / "config.toml", toml_text(config))
                if inputs is not None and not (folder / "inputs.json").exists():
                    write_text(
                        folder / "inputs.json", json.dumps(inputs, indent=1, sort_keys=True) + "\n"
                    )
                _end_line(folder / "metrics.jsonl")
                for torn in folder.rglob(".*.part"):  # a process was killed while it wrote
                    torn.unlink(missing_ok=True)
            except BaseException:
                os.close(lock)
                raise
        return Run(folder, wanted, lock, Log(folder / "log.txt"))

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Let another process have the folder."""
        self._unlock()

    def say(self, text: str) -> None:
        """One log line, on stderr and in log.txt."""
        self.log.say(text)

    def refuse(self, what: str, why: str, fix: str) -> None:
        """For a result that its own evidence does not bear out: raise UserError with exit code 4, or
        with `force` say it and go on."""
        if not self.force:
            raise UserError(what, why, f"{fix}; --force keeps the result", code=EXIT_FAILED)
        self.say(f"note: kept by --force, although {what} ({why})")

    def progress(self, title: str, steps: int | None = None) -> Callable[[int], None]:
        """A progress line for steps besides those of a stage: call it with how many are over.
        steps: how many there will be, or None."""
        return Progress(self.log, title, steps).update

    def done(self, stage: str) -> bool:
        """Did this stage run to its end, now or in an earlier process?"""
        return read_json(self.folder / "stages" / stage / "DONE") is not None

    @contextlib.contextmanager
    def stage(
        self, name: str, *, steps: int | None = None, title: str | None = None
    ) -> Iterator[Stage]:
        """Run one stage: progress, seconds and peak memory; DONE on a clean exit.

        steps: number of steps that `Stage.step` will report, or None. title: what the reader sees
        (else the name).
        """
        stage = Stage(self, name, title or name, steps)
        watch = MemoryWatch().start()
        try:  # a stop that comes right after the first note is told like any other
            self.log.note(
                f"{stage.title}: begun" if stage.earlier == 0 else f"{stage.title}: taken up again"
            )
            with disk_errors(self.folder):
                yield stage
        except BaseException as raised:
            watch.stop()
            error = stopped_by(raised)
            with contextlib.suppress(OSError):
                self.log.note(
                    f"{stage.title}: stopped by {type(error).__name__} after {readable_seconds(stage.seconds)}"
                )
                if isinstance(error, (KeyboardInterrupt, Terminated)):
                    self.say(f"stopped in '{stage.title}'; {stage.where_it_resumes()}")
            if error is raised:
                raise
            raise error from raised
        peak = watch.stop()
        record = {
            "name": name,
            "title": stage.title,
            "seconds": round(stage.seconds, 3),
            "peak_memory": peak,
            "ended": time.time(),
        }
        with disk_errors(self.folder):
            write_text(stage.folder / "DONE", json.dumps(record) + "\n")
        self.say(
            f"{stage.title}: {readable_seconds(stage.seconds)}, peak memory {readable_bytes(peak)}"
        )

    def cached(
        self,
        name: str,
        kind: type[T],
        compute: Callable[[Stage], T],
        *,
        title: str | None = None,
        steps: int | None = None,
    ) -> T:
        """The result of a stage: computed by `compute(stage)` and kept, or read back when done.

        kind: its type, a frozen dataclass (see `relit.records`). title, steps: see `stage`.
        Raises UserError where the result of a finished stage cannot be read, StageReached after the
        stage `until`.
        """
        result = self._cached(name, kind, compute, title, steps)
        if name == self.until:
            raise StageReached(name)
        return result

    def _cached(self, name: str, kind: type[T], compute, title: str | None, steps: int | None) -> T:
        if not self.done(name):
            with self.stage(name, steps=steps, title=title) as stage:
                arrays = to_arrays(compute(stage))
                stage.save("result", **arrays)
            (stage.folder / "checkpoint.npz").unlink(missing_ok=True)  # the result holds it all
            return from_arrays(kind, arrays)  # as a resumed run reads it
        try:
            return from_arrays(kind, run_arrays(self, name, "result"))
        except (LookupError, ValueError, TypeError) as error:
            raise _unreadable_result(name, error, self.folder) from None

    def stages(self) -> list[dict]:
        """The finished stages in the order in which they ended: name, title, seconds, peak_memory
        (bytes)."""
        return read_stages(self.folder)

    def metrics(self) -> list[dict]:
        """The lines of metrics.jsonl; steps that were repeated after a resume appear once, a torn
        last line is left out."""
        return read_metrics(self.folder)


class Stage:
    """What a stage may do with its run. `folder`: RUN/stages/<name>."""

    def __init__(self, run: Run, name: str, title: str, steps: int | None):
        self.run, self.name, self.title, self.steps = run, name, title, steps
        self.folder = run.folder / "stages" / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.earlier = float(
            (read_json(self.folder / "time.json") or {}).get("seconds", 0.0)
        )  # of stopped processes
        self._begun = self._saved = time.monotonic()
        self._unreadable: set[str] = set()  # what was said of them is not said again
        self._written = -math.inf
        self._interval = CHECKPOINT_SECONDS
        self._shown = time.monotonic()
        self._progress = Progress(run.log, title, steps)

    @property
    def seconds(self) -> float:
        """Time spent in this stage, that of earlier processes up to their last checkpoint
        included."""
        return self.earlier + time.monotonic() - self._begun

    def step(self, i: int, /, **losses: float | Callable[[], float]) -> None:
        """Tell that `i` steps (1 ... `steps`) are over. A loss given as a callable is evaluated
        only when a line is written."""
        now = time.monotonic()
        values: dict[str, float] = {}
        if losses and (now - self._written >= METRICS_SECONDS or i == self.steps):
            values = {key: float(v() if callable(v) else v) for key, v in losses.items()}
            self._written = now
            of = {} if self.steps is None else {"of": self.steps}
            record = {
                "stage": self.name,
                "step": i,
                **of,
                "seconds": round(self.seconds, 3),
                **{k: _finite(v) for k, v in values.items()},
            }
            with (self.run.folder / "metrics.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
        self._progress.update(i, values)

    def checkpoint_due(self) -> bool:
        """True when the last checkpoint (or the beginning) is 20 s ago; up to 60 s where writing
        one takes long."""
        return time.monotonic() - self._saved >= self._interval

    def save(self, name: str, /, **arrays) -> None:
        """Write arrays to <name>.npz in the stage's folder, atomically. Anything `np.asarray`
        takes, but no objects."""
        begun = time.monotonic()
        with disk_errors(self.run.folder):
            save_arrays(self.folder / f"{name}.npz", arrays)
            write_text(self.folder / "time.json", json.dumps({"seconds": round(self.seconds, 3)}))
        self._saved = time.monotonic()
        self._interval = min(
            max(CHECKPOINT_SECONDS, 10 * (self._saved - begun)), CHECKPOINT_LONGEST
        )

    def where_it_resumes(self) -> str:
        """What the same command will do after a stop now."""
        if not any(self.folder.glob("*.npz")):
            return "the same command begins this stage anew"
        return f"the same command goes on from the checkpoint of {readable_seconds(time.monotonic() - self._saved)} ago"

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """The arrays of <name>.npz, or None if there is none or it cannot be read (then a line says
        so)."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        try:
            return load_arrays(path)
        except NO_ARRAYS as error:
            if name not in self._unreadable:
                self.run.say(
                    f"note: {path} cannot be read ({type(error).__name__}) and is left out"
                )
                self._unreadable.add(name)
            return None

    def preview_due(self) -> bool:
        """True when the last preview (or the beginning) is 10 s ago."""
        return time.monotonic() - self._shown >= PREVIEW_SECONDS

    def preview(self, picture: Callable[[], np.ndarray]) -> None:
        """Write the linear (H, W, 3) picture that `picture` makes to previews/<stage>.jpg."""
        from relit.images import write_srgb

        folder = self.run.folder / "previews"
        with disk_errors(self.run.folder):
            folder.mkdir(exist_ok=True)
            write_srgb(folder / f"{self.name}.jpg", picture())
        self._shown = time.monotonic()


def run_arrays(run: Run, stage: str, name: str) -> dict[str, np.ndarray]:
    """Arrays that a finished stage has kept. Raises UserError where they cannot be read."""
    path = run.folder / "stages" / stage / f"{name}.npz"
    try:
        return load_arrays(path)
    except NO_ARRAYS as error:
        raise _unreadable_result(stage, error, path) from None


def _unreadable_result(stage: str, error: Exception, path: Path) -> UserError:
    return UserError(
        f"the result of the finished stage '{stage}' cannot be read ({type(error).__name__})",
        "the file was damaged or removed; later stages were computed from it",
        f"give the same command with --overwrite to begin anew: {path}",
    )


def read_stages(folder: Path) -> list[dict]:
    """The records of RUN's finished stages, see `Run.stages`."""
    records = [read_json(p) for p in (Path(folder) / "stages").glob("*/DONE")]
    return sorted((r for r in records if r), key=lambda r: r["ended"])


def read_metrics(folder: Path) -> list[dict]:
    """The lines of RUN/metrics.jsonl, see `Run.metrics`."""
    path = Path(folder) / "metrics.jsonl"
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    out: list[dict] = []
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and "stage" in record and "step" in record:
            while out and out[-1]["stage"] == record["stage"] and out[-1]["step"] >= record["step"]:
                out.pop()
            out.append(record)
    return out


# ---------------------------------------------------------------- stopping, holding, comparing


_asked_to_stop: list[type[BaseException]] = []  # by a signal, while `termination` is entered


@contextlib.contextmanager
def termination() -> Iterator[None]:
    """While inside, SIGINT raises KeyboardInterrupt and SIGTERM `Terminated` in the main thread,
    and `stopped_by` remembers it.

    It must be remembered: native loops (Dr.Jit's) turn whatever passes through them into a
    RuntimeError.
    """

    def raising(kind: type[BaseException]):
        def stop(*_):
            _asked_to_stop.append(kind)
            raise kind

        return stop

    before = {number: signal.signal(number, raising(kind)) for number, kind in STOPS.items()}
    _asked_to_stop.clear()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stopped_by(error: BaseException) -> BaseException:
    """The stop behind `error` where a signal caused it, else `error` itself."""
    if _asked_to_stop and not isinstance(error, (KeyboardInterrupt, Terminated)):
        return _asked_to_stop[0]()
    return error


def _refuse_foreign(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError("the output is a file, not a folder", fix=f"give another -o: {folder}")
    if (
        folder.is_dir()
        and not (folder / "config.toml").exists()
        and any(p.name != "lock" for p in folder.iterdir())
    ):
        what = "the output folder is not empty and is no Relit run"
        raise UserError(what, "nothing was overwritten", f"give a new folder with -o: {folder}")


def _lock(folder: Path) -> int:
    handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.read(handle, 32).decode("ascii", "replace").strip()
        os.close(handle)
        raise UserError(
            f"another process works in this run folder (process {owner or 'unknown'})",
            "two jobs in one folder would overwrite each other",
            f"wait for it, stop it (kill {owner or 'PID'}), or use another -o: {folder}",
        ) from None
    except OSError:
        return handle  # a file system without locks: work without one
    os.ftruncate(handle, 0)
    os.pwrite(handle, str(os.getpid()).encode(), 0)
    return handle


def _remove_owned(folder: Path) -> None:
    for name in OWNED:
        path = folder / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _compare(folder: Path, wanted: dict, inputs: dict[str, str] | None) -> None:
    path = folder / "config.toml"
    if not path.exists():
        return
    try:
        saved = parse_toml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(
            f"the run's config.toml cannot be read: {error}",
            fix=f"use another -o, or --overwrite: {path}",
        ) from None
    if saved.get("run_format", 1) != RUN_FORMAT:
        raise UserError(
            "the run folder was made by another version of Relit, whose stages cannot be resumed",
            f"its format is {saved.get('run_format', 1)}, this version's is {RUN_FORMAT}; "
            "a finished asset in it can still be viewed, relit and exported",
            f"use another -o, or --overwrite to begin anew: {path}",
            code=EXIT_USAGE,
        )
    a, b = _flat(saved), _flat(wanted)
    keys = [k for k in dict.fromkeys([*a, *b]) if a.get(k) != b.get(k)]
    if keys:
        said = ", ".join(f"{k} was {_shown(a.get(k))}, is now {_shown(b.get(k))}" for k in keys)
        raise UserError(
            f"the folder holds a run with other settings: {said}",
            "a run is resumed with the settings it was begun with; nothing was overwritten",
            f"use another -o, the old settings, or --overwrite to begin anew: {folder}",
            code=EXIT_USAGE,
        )
    before = read_json(folder / "inputs.json")
    if before is None and (folder / "inputs.json").exists():
        fix = f"use another -o, or --overwrite to begin anew: {folder / 'inputs.json'}"
        raise UserError(
            "the run's inputs.json cannot be read",
            "whether the photos are still the same is not known",
            fix,
        )
    if inputs is not None and before is not None and before != inputs:
        changed = [k for k in dict.fromkeys([*before, *inputs]) if before.get(k) != inputs.get(k)]
        listed = ", ".join(changed[:5]) + (" ..." if len(changed) > 5 else "")
        raise UserError(
            f"{len(changed)} input files are not the ones this run was begun with: {listed}",
            "photos were replaced, added or removed; what was computed from the old ones would not fit",
            f"use another -o, or --overwrite to begin anew: {folder}",
        )


def _shown(value) -> str:
    return "not set" if value is None else repr(value)


def _flat(config: dict) -> dict:
    out = {}
    for key, value in config.items():
        out.update(
            {f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
        )
    return out


def _end_line(path: Path) -> None:
    """A killed process may have left half a line: end it, so that the next one stands alone."""
    if path.exists() and path.stat().st_size and not path.read_bytes().endswith(b"\n"):
        with path.open("ab") as file:
            file.write(b"\n")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None  # JSON has no NaN
