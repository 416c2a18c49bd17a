"""One suite from end to end. A reconstruction runs as a command of its own: its time counts the
cold start, its memory is its own."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from relit.benchmark.cost import COST_DEFINITIONS, machine, timed
from relit.benchmark.results import markdown, means, means_table
from relit.benchmark.suites import SUITES, Item, Suite, function_at
from relit.errors import EXIT_FAILED, UserError, did_you_mean
from relit.evaluate.results import entries
from relit.files import write_text


def run_suite(
    suite: str = "multiview",
    *,
    quality: str = "standard",
    ablate: Sequence[str] = (),
    json_file: str | Path | None = None,
    device: str = "auto",
    cache: str | Path | None = None,
    assets: str | Path | None = None,
    objects: Sequence[str] = (),
    out: str | Path | None = None,
    spp: int | None = None,
    seed: int = 0,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Synthesize, reconstruct and evaluate every object of a suite, plain and with each ablation.

    assets: folder with `assets` and `envmaps`. objects: names to limit the suite to. ablate: names
    of the suite's ablations or `key=value`.
    out: folder for the runs and the results, by default a new one in the cache. spp: samples a
    pixel of the compared pictures, by default as many as `relit evaluate` takes.
    Returns {"suite", "quality", "device", "machine", "runs": {variant: {object: {"metrics", ...}}},
    "failed": {variant: {object: reason}}, "means": {variant: {figure: value}}}. What fails is told
    and the others go on; a variant of which an object failed has no means.
    Raises UserError (exit code 4) in the end if a plain run failed; an ablated one may, as that is
    its result.
    """
    from relit.device import use_device

    spec, items = _chosen(suite, objects)
    variants = {
        "plain": (),
        **{name: spec.ablations.get(name, (name,)) for name in _checked_ablations(spec, ablate)},
    }
    data, store = data_folder(assets), cache_folder(cache)
    used = use_device(device)
    folder = (
        Path(out) if out else store / "runs" / f"{suite}-{quality}-{time.strftime('%Y%m%d-%H%M%S')}"
    )
    captures = {item.name: synthesize_item(spec, item, data, store, say) for item in items}
    evaluate, samples = function_at(spec.evaluate), {} if spp is None else {"spp": spp}

    result: dict[str, Any] = {
        "suite": suite,
        "quality": quality,
        "device": used,
        "seed": seed,
        "machine": machine(),
        "runs": {},
        "failed": {},
        "means": {},
    }
    for variant, words in variants.items():
        result["runs"][variant], result["failed"][variant] = {}, {}
        for name, capture in captures.items():
            run = folder / f"{name}-{variant.replace('=', '_').replace('/', '_')}"
            if run.exists():
                raise UserError(
                    "a run of that name is there already",
                    "a resumed run cannot be timed",
                    f"choose another folder: {run}",
                )
            command = reconstruct_command(
                capture, run, spec.kind, quality, used, seed, (*spec.flags, *words)
            )
            say(f"{name} ({variant}): {' '.join(command[1:])}")
            try:
                seconds, memory = timed(command, folder / "logs" / f"{run.name}.txt")
                say(f"{name} ({variant}): {seconds:.0f} s, {memory:.2f} GB; evaluating")
                entry = evaluate(run, capture, **samples)
            except UserError as error:
                say(f"{name} ({variant}): failed: {error}")
                result["failed"][variant][name] = str(error)
            else:
                costs = entries({"seconds": seconds, "peak_memory": memory}, COST_DEFINITIONS)
                entry["metrics"] = {**costs, **entry["metrics"]}
                result["runs"][variant][name] = {**entry, "run": run.name, "capture": capture.name}
            result["means"][variant] = (
                {} if result["failed"][variant] else means(result["runs"][variant])
            )
            _save(result, spec, folder, json_file)
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(means_table(result, spec))
    say(f"results: {folder / 'results.json'}, {folder / 'results.md'}")
    if failed := result["failed"]["plain"]:
        reasons = "\n".join(f"{name}: {reason}" for name, reason in failed.items())
        raise UserError(
            f"{len(failed)} of {len(items)} runs failed",
            reasons,
            f"what did not: {folder / 'results.md'}",
            code=EXIT_FAILED,
        )
    return result


def cache_folder(cache: str | Path | None = None) -> Path:
    """Where rendered captures are kept: `cache`, else RELIT_CACHE, else ~/.cache/relit."""
    return Path(cache or os.environ.get("RELIT_CACHE") or Path.home() / ".cache" / "relit")


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

    light = (
        data / item.light if isinstance(item.light, str) else [data / each for each in item.light]
    )
    options = {**suite.options, **item.options, "relights": [data / r for r in suite.relights]}
    settings = function_at(suite.synthesize.rpartition(".")[0] + ".settings_of")(
        data / item.asset, light, **options
    )
    out = cache / "captures" / f"{item.name}-{settings_hash(settings)}"
    return function_at(suite.synthesize)(
        data / item.asset, light, out, **options, say=lambda t: say(f"{item.name}: {t}")
    )


def reconstruct_command(
    capture: Path,
    out: Path,
    kind: str,
    quality: str,
    device: str,
    seed: int,
    words: Sequence[str] = (),
) -> list[str]:
    """The command line that is timed. words: flags ('--masks=none') and settings ('key=value')."""
    command = [
        sys.executable,
        "-m",
        "relit",
        "reconstruct",
        str(capture),
        "-o",
        str(out),
        "--capture",
        kind,
    ]
    command += ["--quality", quality, "--device", device, "--seed", str(seed)]
    for word in words:
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


def _save(result: dict[str, Any], suite: Suite, folder: Path, json_file: str | Path | None) -> None:
    text = json.dumps(result, indent=1)
    for target in [folder / "results.json", *([Path(json_file)] if json_file else [])]:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, text)
    write_text(folder / "results.md", markdown(result, suite))
