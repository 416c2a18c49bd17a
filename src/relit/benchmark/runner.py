"""One suite from end to end. A reconstruction runs as a command of its own: its time counts the
cold start, its memory is its own."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from relit.benchmark.cost import COST_DEFINITIONS, machine, timed
from relit.benchmark.records import record_of, repository, state_of_code, write_record
from relit.benchmark.results import markdown, means, means_table
from relit.benchmark.suites import SUITES, Item, Suite, function_at
from relit.errors import EXIT_FAILED, EXIT_USAGE, UserError, did_you_mean
from relit.evaluate.results import entries
from relit.files import cache_folder, write_text


@dataclass(frozen=True)
class SuiteOptions:
    """What a run over a suite is asked for.

    assets: folder with `assets` and `envmaps`. cache: folder of the rendered captures. objects:
    names to limit the suite to. ablate: names of the suite's ablations or `key=value`. out: folder
    for the runs and the results, by default a new one in the cache. spp: samples per pixel of the
    compared pictures, by default as many as `relit evaluate` takes. json_file: where the record of
    the run is written (`relit.benchmark.records`); an existing file is not overwritten.
    """

    quality: str = "standard"
    ablate: Sequence[str] = ()
    objects: Sequence[str] = ()
    device: str = "auto"
    seed: int = 0
    spp: int | None = None
    cache: str | Path | None = None
    assets: str | Path | None = None
    out: str | Path | None = None
    json_file: str | Path | None = None


def run_suite(
    suite: str, options: SuiteOptions = SuiteOptions(), say: Callable[[str], None] = print
) -> dict[str, Any]:
    """Synthesize, reconstruct and evaluate every object of a suite, plain and with each ablation.

    Returns {"suite", "quality", "device", "machine", "runs": {variant: {object: {"metrics", ...}}},
    "failed": {variant: {object: reason}}, "means": {variant: {figure: value}}}. A failed object is
    reported and the others go on; a variant of which an object failed has no means.
    Raises UserError (exit code 4) in the end if a plain run failed; an ablated one may fail, as
    that is its result.
    """
    from relit.device import use_device

    spec, items = _chosen(suite, options.objects)
    variants = {
        "plain": (),
        **{
            name: spec.ablations.get(name, (name,))
            for name in _checked_ablations(spec, options.ablate)
        },
    }
    data, store = data_folder(options.assets), cache_folder(options.cache)
    used = use_device(options.device)
    if options.json_file and Path(options.json_file).exists():
        what = "the file for the record exists already"
        fix = f"choose another --json, or remove it: {options.json_file}"
        raise UserError(what, "nothing was overwritten", fix, code=EXIT_USAGE)
    folder = (
        Path(options.out)
        if options.out
        else store / "runs" / f"{suite}-{options.quality}-{time.strftime('%Y%m%d-%H%M%S')}"
    )
    captures = {item.name: synthesize_item(spec, item, data, store, say) for item in items}
    evaluate, samples = (
        function_at(spec.evaluate),
        {} if options.spp is None else {"spp": options.spp},
    )

    result: dict[str, Any] = {
        "suite": suite,
        "quality": options.quality,
        "device": used,
        "seed": options.seed,
        "machine": machine(),
        "runs": {},
        "failed": {},
        "means": {},
    }
    for variant, words in variants.items():
        result["runs"][variant], result["failed"][variant] = {}, {}
        for name, capture in captures.items():
            run = folder / f"{name}-{variant.replace('=', '_').replace('/', '_')}"
            target = Target(spec.kind, options.quality, used, options.seed, (*spec.flags, *words))
            try:
                result["runs"][variant][name] = _measured(
                    f"{name} ({variant})", capture, run, target, partial(evaluate, **samples), say
                )
            except UserError as error:
                if error.code == EXIT_USAGE:
                    raise
                say(f"{name} ({variant}): failed: {error}")
                result["failed"][variant][name] = str(error)
            result["means"][variant] = (
                {} if result["failed"][variant] else means(result["runs"][variant])
            )
            _save(result, spec, folder, options)
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(means_table(result, spec))
    say(f"results: {options.json_file or folder / 'results.json'}, {folder / 'results.md'}")
    if failed := result["failed"]["plain"]:
        raise UserError(
            f"{len(failed)} of {len(items)} runs failed",
            "\n".join(f"{name}: {reason}" for name, reason in failed.items()),
            f"see {folder / 'results.md'}",
            code=EXIT_FAILED,
        )
    return result


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
    target: Target,
    evaluate: Callable[[Path, Path], dict[str, Any]],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Reconstruct a capture in a process of its own, and evaluate it: its entry of the result."""
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

    A seed whose record exists already is left out, so that a stopped series goes on.
    """
    for seed in range(options.seed, options.seed + seeds):
        file = record_file(suite, options, seed)
        if file.exists():
            say(f"seed {seed}: measured already: {file}")
            continue
        out = Path(options.out) / f"seed-{seed}" if options.out else None
        run_suite(suite, replace(options, seed=seed, json_file=file, out=out), say)


def record_file(suite: str, options: SuiteOptions, seed: int) -> Path:
    """Where the record of one seed is written: options.json_file with the seed in its name, else
    benchmarks/results/ of the checkout, else the working folder."""
    if options.json_file:
        given = Path(options.json_file)
        return given.with_name(f"{given.stem}-{seed}{given.suffix or '.json'}")
    root = repository()
    folder = Path.cwd() if root is None else root / "benchmarks" / "results"
    return folder / f"{suite}-{options.quality}-{state_of_code()[0]}-{seed}.json"


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
    suite: Suite, item: Item, data: Path, cache: Path, say: Callable[[str], None] = print
) -> Path:
    """The capture of one object, rendered if the cache does not hold it. The folder's name carries
    a hash of all settings."""
    from relit.synthesize.multiview import settings_hash
    from relit.synthesize.objects import object_file

    light = (
        data / item.light if isinstance(item.light, str) else [data / each for each in item.light]
    )
    options = {**suite.options, **item.options, "relights": [data / r for r in suite.relights]}
    asset = object_file(data / item.asset)
    settings = function_at(suite.synthesize.rpartition(".")[0] + ".settings_of")(
        asset, light, **options
    )
    out = cache / "captures" / f"{item.name}-{settings_hash(settings)}"
    return function_at(suite.synthesize)(
        asset, light, out, **options, say=lambda t: say(f"{item.name}: {t}")
    )


def reconstruct_command(capture: Path, out: Path, target: Target) -> list[str]:
    """The command line that is timed."""
    command = [sys.executable, "-m", "relit", "reconstruct", str(capture), "-o", str(out)]
    command += ["--capture", target.kind, "--quality", target.quality]
    command += ["--device", target.device, "--seed", str(target.seed)]
    for word in target.words:
        command += [word] if word.startswith("--") else ["--set", word]
    return command


def _chosen(suite: str, objects: Sequence[str]) -> tuple[Suite, tuple[Item, ...]]:
    if suite not in SUITES:
        raise UserError(
            f"unknown suite '{suite}'.{did_you_mean(suite, SUITES)}",
            fix=f"choose one of: {', '.join(SUITES)}",
            code=2,
        )
    spec = SUITES[suite]
    names = [item.name for item in spec.items]
    for name in objects:
        if name not in names:
            raise UserError(
                f"no object '{name}' in this suite.{did_you_mean(name, names)}",
                fix=f"choose of: {', '.join(names)}",
                code=2,
            )
    return spec, tuple(item for item in spec.items if not objects or item.name in objects)


def _checked_ablations(suite: Suite, ablate: Sequence[str]) -> list[str]:
    for name in ablate:
        if name not in suite.ablations and "=" not in name:
            raise UserError(
                f"unknown ablation '{name}'.{did_you_mean(name, suite.ablations)}",
                fix=f"choose of: {', '.join(suite.ablations) or 'none is named'}; or give key=value, as for `relit reconstruct --set`",
                code=2,
            )
    return list(ablate)


def _save(result: dict[str, Any], suite: Suite, folder: Path, options: SuiteOptions) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "results.json", json.dumps(result, indent=1))
    write_text(folder / "results.md", markdown(result, suite))
    if options.json_file:
        asked = {"objects": list(options.objects), "ablate": list(options.ablate)}
        write_record(record_of(result, {**asked, "spp": options.spp}), Path(options.json_file))
