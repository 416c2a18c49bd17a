"""One suite from end to end. A reconstruction runs as a command of its own: its time counts the
cold start, its memory is its own."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from relit.benchmark.cost import COST_DEFINITIONS, machine, timed
from relit.benchmark.progress import Measured, Share, read_progress, remaining, summarised
from relit.benchmark.records import (
    read_record,
    record_of,
    repository,
    state_of_code,
    write_record,
)
from relit.benchmark.results import markdown, means_table
from relit.benchmark.splits import SPLIT_NAMES
from relit.benchmark.suites import SUITES, Item, Suite, function_at
from relit.errors import EXIT_FAILED, EXIT_USAGE, UserError, did_you_mean
from relit.evaluate.results import entries
from relit.files import cache_folder, write_text


@dataclass(frozen=True)
class SuiteOptions:
    """What a run over a suite is asked for.

    split: 'tune' or 'report' (`benchmark.splits`), '' for `Suite.default_split`. assets: folder
    with `assets` and `envmaps`. cache: folder of the rendered captures. objects: names to limit the suite to. ablate: names of
    the suite's ablations or `key=value`. out: folder for the runs and the results, by default a new
    one in the cache; in a folder of an earlier call with the same options the measured objects are
    kept and the others follow. share: which part of the objects this call measures, and for how
    long. spp: samples per pixel of the compared pictures, by default as many as `relit evaluate`
    takes. json_file: where the record of the run is written (`relit.benchmark.records`); that of a
    finished run is not overwritten.
    """

    quality: str = "standard"
    split: str = ""
    ablate: Sequence[str] = ()
    objects: Sequence[str] = ()
    device: str = "auto"
    seed: int = 0
    spp: int | None = None
    cache: str | Path | None = None
    assets: str | Path | None = None
    out: str | Path | None = None
    json_file: str | Path | None = None
    share: Share = field(default_factory=Share)


def run_suite(
    suite: str, options: SuiteOptions = SuiteOptions(), say: Callable[[str], None] = print
) -> dict[str, Any]:
    """Synthesize, reconstruct and evaluate every object of a suite, plain and with each ablation.

    Returns {"suite", "split", "quality", "device", "seed", "machine", "commit", "objects", "runs":
    {variant: {object: {"metrics", ...}}}, "failed": {variant: {object: reason}}, "means": {variant:
    {figure: value}}, "unfinished": [objects that are left for the next call]}. It is written after
    each object, so that a stopped call is continued by the next one with the same `out`. A failed
    object is reported and the others go on; a variant of which an object failed or is missing has
    no means.
    Raises UserError (exit code 4) in the end if a plain run failed; an ablated one may fail, as
    that is its result.
    """
    from relit.device import use_device

    options = _with_split(suite, options)
    spec, items = _chosen(suite, options)
    variants = {
        "plain": (),
        **{
            name: spec.ablations.get(name, (name,))
            for name in _checked_ablations(spec, options.ablate)
        },
    }
    mine = options.share.of([item.name for item in items])
    used = use_device(options.device)
    _check_record(options)
    folder = _folder(suite, options)
    head = {
        "suite": suite,
        "split": options.split,
        "quality": options.quality,
        "device": used,
        "seed": options.seed,
        "machine": machine(),
        "commit": list(state_of_code()),
        "objects": [item.name for item in items],
    }
    measured, resumed = read_progress(folder, head, tuple(variants))
    work = Work(spec, options, folder, used, resumed)
    until = time.monotonic() + 60 * options.share.minutes
    result = _saved(work, summarised(head, measured))
    for item in items:
        todo = [v for v in variants if not measured.has(v, item.name)]
        if item.name not in mine or not todo:
            continue
        if time.monotonic() >= until:
            break
        for variant in todo:
            _measure(work, item, (variant, variants[variant]), measured, say)
            result = _saved(work, summarised(head, measured))
    _tell(work, result, say)
    return result


def _tell(work: Work, result: dict[str, Any], say: Callable[[str], None]) -> None:
    """The table of a call, what it has left, and what failed."""
    from rich.console import Console

    folder, options = work.folder, work.options
    Console(width=None if sys.stdout.isatty() else 160).print(means_table(result, work.suite))
    say(f"results: {options.json_file or folder / 'results.json'}, {folder / 'results.md'}")
    if left := result["unfinished"]:
        say(f"left for the next call, --out {folder}: {', '.join(left)}")
    if failed := result["failed"]["plain"]:
        raise UserError(
            f"{len(failed)} of {len(result['objects'])} runs failed",
            "\n".join(f"{name}: {reason}" for name, reason in failed.items()),
            f"see {folder / 'results.md'}",
            code=EXIT_FAILED,
        )


def _folder(suite: str, options: SuiteOptions) -> Path:
    """Where the runs go: a new folder unless one is named."""
    if options.out:
        return Path(options.out)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{suite}-{options.split}-{options.quality}-{stamp}"
    return cache_folder(options.cache) / "runs" / name


def _check_record(options: SuiteOptions) -> None:
    """Raise UserError where the record of a finished run would be overwritten."""
    file = options.json_file
    if file and Path(file).exists() and not remaining(read_record(Path(file)).options):
        what = "the file for the record exists already"
        fix = f"choose another --json, or remove it: {file}"
        raise UserError(what, "nothing was overwritten", fix, code=EXIT_USAGE)


@dataclass(frozen=True)
class Work:
    """What every object of a call needs. folder: of its runs. device: the one that is used.
    resumed: whether an earlier call has worked in the folder."""

    suite: Suite
    options: SuiteOptions
    folder: Path
    device: str
    resumed: bool


def _measure(
    work: Work,
    item: Item,
    variant: tuple[str, tuple[str, ...]],
    measured: Measured,
    say: Callable[[str], None],
) -> None:
    """Measure one object with a variant (name, words) and note its figures, or why it failed. A
    capture that cannot be rendered is no result: its UserError ends the call."""
    options, (name, words) = work.options, variant
    label = f"{item.name} ({name})"
    capture = synthesize_item(work.suite, item, options, say)
    try:
        run = work.folder / f"{item.name}-{name.replace('=', '_').replace('/', '_')}"
        if run.exists() and work.resumed:
            say(f"{label}: an unfinished run is removed and starts again: {run}")
            shutil.rmtree(run)
        flags = (*work.suite.flags, *item.flags, *words)
        target = Target(work.suite.kind, options.quality, work.device, options.seed, flags)
        samples = {} if options.spp is None else {"spp": options.spp}
        evaluate = partial(function_at(work.suite.evaluate), **samples)
        entry = _measured(label, capture, run, (target, evaluate), say)
        measured.runs[name][item.name] = entry
    except UserError as error:
        if error.code == EXIT_USAGE:
            raise
        say(f"{label}: failed: {error}")
        measured.failed[name][item.name] = str(error)


@dataclass(frozen=True)
class Target:
    """What `relit reconstruct` is asked for. words: flags ('--masks=none') and settings
    ('key=value')."""

    kind: str
    quality: str
    device: str
    seed: int
    words: tuple[str, ...] = ()


def _measured(
    label: str,
    capture: Path,
    run: Path,
    how: tuple[Target, Callable[[Path, Path], dict[str, Any]]],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Reconstruct a capture in a process of its own, and evaluate it: its entry of the result."""
    target, evaluate = how
    if run.exists():
        raise UserError(
            "a run of that name exists already",
            "the time of a resumed run would mean nothing",
            f"choose another folder: {run}",
            code=EXIT_USAGE,
        )
    command = reconstruct_command(capture, run, target)
    say(f"{label}: {' '.join(command[1:])}")
    seconds, memory = timed(command, run.parent / "logs" / f"{run.name}.txt")
    say(f"{label}: {seconds:.0f} s, {memory:.2f} GB; evaluating")
    entry = evaluate(run, capture)
    costs = entries({"seconds": seconds, "peak_memory": memory}, COST_DEFINITIONS)
    entry["metrics"] = {**costs, **entry["metrics"]}
    return {**entry, "run": run.name, "capture": capture.name}


def run_seeds(
    suite: str, options: SuiteOptions, seeds: int, say: Callable[[str], None] = print
) -> None:
    """`run_suite` with several seeds, from options.seed on; each writes a record of its own.

    A seed whose record is complete is left out, so that a stopped series goes on. options.share
    counts for the whole call: its minutes are those of all seeds.
    """
    start, options = time.monotonic(), _with_split(suite, options)
    for seed in range(options.seed, options.seed + seeds):
        file = record_file(suite, options, seed)
        if file.exists() and not remaining(read_record(file).options):
            say(f"seed {seed}: measured already: {file}")
            continue
        left = options.share.minutes - (time.monotonic() - start) / 60
        if left <= 0:
            say(f"seed {seed}: left for the next call")
            continue
        runs = cache_folder(options.cache) / "runs" / file.stem
        out = Path(options.out) / f"seed-{seed}" if options.out else runs
        share = replace(options.share, minutes=left)
        given = replace(options, seed=seed, json_file=file, out=out, share=share)
        run_suite(suite, given, say)


def record_file(suite: str, options: SuiteOptions, seed: int) -> Path:
    """Where the record of one seed is written: options.json_file with the seed in its name, else
    benchmarks/results/ of the checkout, else the working folder."""
    if options.json_file:
        given = Path(options.json_file)
        return given.with_name(f"{given.stem}-{seed}{given.suffix or '.json'}")
    root = repository()
    folder = Path.cwd() if root is None else root / "benchmarks" / "results"
    split = "" if options.split == "tune" else f"-{options.split}"
    return folder / f"{suite}{split}-{options.quality}-{state_of_code()[0]}-{seed}.json"


def data_folder(given: str | Path | None = None) -> Path:
    """Folder with `assets` and `envmaps`: `given`, else RELIT_DATA, else shared/data beside the
    working folder or above it."""
    if given is None and not os.environ.get("RELIT_DATA"):
        candidates = [Path("..") / "shared" / "data", Path("shared") / "data"]
        candidates += [p / "shared" / "data" for p in Path(__file__).resolve().parents]
    else:
        candidates = [Path(given or os.environ["RELIT_DATA"])]
    for folder in candidates:
        if (folder / "assets").is_dir() and (folder / "envmaps").is_dir():
            return folder
    raise UserError(
        "the suite's assets are not there",
        "the objects and environment maps are third-party data that Relit does not ship",
        f"give the folder that holds `assets` and `envmaps` with --assets; looked at: {', '.join(map(str, candidates[:2]))}",
    )


def synthesize_item(
    suite: Suite, item: Item, options: SuiteOptions, say: Callable[[str], None] = print
) -> Path:
    """The capture of one object, rendered if the cache does not hold it. The folder's name carries
    a hash of all settings."""
    from relit.synthesize.multiview import settings_hash
    from relit.synthesize.objects import object_file

    data, cache = data_folder(options.assets), cache_folder(options.cache)
    light = (
        data / item.light if isinstance(item.light, str) else [data / each for each in item.light]
    )
    relights = [data / r for r in suite.relights_of(options.split)]
    how = {**suite.options, **item.options, "relights": relights}
    asset = object_file(data / item.asset)
    settings = suite.settings_function()(asset, light, **how)
    out = cache / "captures" / f"{item.name}-{settings_hash(settings)}"
    return function_at(suite.synthesize)(
        asset, light, out, **how, say=lambda t: say(f"{item.name}: {t}")
    )


def reconstruct_command(capture: Path, out: Path, target: Target) -> list[str]:
    """The command line that is timed."""
    command = [sys.executable, "-m", "relit", "reconstruct", str(capture), "-o", str(out)]
    command += ["--capture", target.kind, "--quality", target.quality]
    command += ["--device", target.device, "--seed", str(target.seed)]
    for word in target.words:
        command += [word] if word.startswith("--") else ["--set", word]
    return command


def _with_split(suite: str, options: SuiteOptions) -> SuiteOptions:
    """The options with the suite's own split where none is named."""
    own = SUITES[suite].default_split() if suite in SUITES else "tune"
    return replace(options, split=options.split or own)


def _chosen(suite: str, options: SuiteOptions) -> tuple[Suite, tuple[Item, ...]]:
    """The suite and its objects that were asked for. Raises UserError for unknown names."""
    for name, known, what in (
        (suite, SUITES, "suite"),
        (options.split, SPLIT_NAMES, "split"),
    ):
        if name not in known:
            raise UserError(
                f"unknown {what} '{name}'.{did_you_mean(name, known)}",
                fix=f"choose one of: {', '.join(known)}",
                code=2,
            )
    spec = SUITES[suite]
    items = spec.items_of(options.split)
    names = [item.name for item in items]
    if not items:
        what = f"suite '{suite}' has no objects of split '{options.split}'"
        raise UserError(what, fix=f"--split {spec.default_split()}", code=2)
    for name in options.objects:
        if name not in names:
            raise UserError(
                f"no object '{name}' in this suite.{did_you_mean(name, names)}",
                fix=f"choose of: {', '.join(names)}",
                code=2,
            )
    return spec, tuple(i for i in items if not options.objects or i.name in options.objects)


def _checked_ablations(suite: Suite, ablate: Sequence[str]) -> list[str]:
    for name in ablate:
        if name not in suite.ablations and "=" not in name:
            raise UserError(
                f"unknown ablation '{name}'.{did_you_mean(name, suite.ablations)}",
                fix=f"choose of: {', '.join(suite.ablations) or 'none is named'}; or give key=value, as for `relit reconstruct --set`",
                code=2,
            )
    return list(ablate)


def _saved(work: Work, result: dict[str, Any]) -> dict[str, Any]:
    """Write the result, its tables and its record; returns it."""
    folder, options = work.folder, work.options
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "results.json", json.dumps(result, indent=1))
    write_text(folder / "results.md", markdown(result, work.suite))
    if options.json_file:
        asked = {"objects": list(options.objects), "ablate": list(options.ablate)}
        left = {"unfinished": result["unfinished"]} if result["unfinished"] else {}
        record = record_of(result, {**asked, "spp": options.spp, **left})
        write_record(record, Path(options.json_file))
    return result
