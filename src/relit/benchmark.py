"""`relit benchmark SUITE`: synthesize (cached) + reconstruct + evaluate over a suite, one table.

A reconstruction runs as a command of its own, so that its time counts the cold start and its memory is its own.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.errors import EXIT_FAILED, UserError, did_you_mean
from relit.files import write_text


@dataclass(frozen=True)
class Item:
    """One object of a suite: files relative to the data folder (`assets/...`, `envmaps/...`), and constants that replace its maps."""

    name: str
    asset: str
    light: str
    roughness: float | None = None
    metallic: float | None = None


@dataclass(frozen=True)
class Suite:
    """What is rendered. spp, test_spp: samples a pixel of training photos, and of test and relit views."""

    items: tuple[Item, ...]
    relights: tuple[str, ...]
    views: int = 60
    test_views: int = 12
    resolution: int = 400
    spp: int = 64
    test_spp: int = 256
    seed: int = 0


SUITES: dict[str, Suite] = {
    "multiview": Suite(
        items=(
            Item("spot", "assets/spot/spot.obj", "envmaps/lebombo_1k.hdr", roughness=0.4, metallic=0.0),
            Item("boombox", "assets/BoomBox.glb", "envmaps/kiara_1_dawn_1k.hdr"),
            Item("stool", "assets/painted_wooden_stool_1k.glb", "envmaps/immenstadter_horn_1k.hdr"),  # a sun of 7040
        ),
        relights=("envmaps/adams_place_bridge_1k.hdr", "envmaps/forest_slope_1k.hdr"),
    )
}

# Bars of the suite's means: (figure, '>=' or '<=', value at quality standard)
BARS: dict[str, tuple[str, float]] = {
    "seconds": ("<=", 360.0),
    "peak_memory": ("<=", 4.0),
    "novel_psnr": (">=", 32.0),
    "relit_psnr": (">=", 31.0),
    "albedo_psnr": (">=", 26.0),
    "normal_mae": ("<=", 8.0),
    "chamfer_percent": ("<=", 0.5),
    "glb_roundtrip_psnr": (">=", 35.0),
}
DRAFT_SECONDS = 90.0
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

# Ablations of `--ablate`: name -> settings given to `relit reconstruct` as --set. Any key=value is an ablation of its own too.
ABLATIONS: dict[str, tuple[str, ...]] = {}


def cache_folder(cache: str | Path | None = None) -> Path:
    """Where rendered captures are kept: `cache`, else RELIT_CACHE, else ~/.cache/relit."""
    return Path(cache or os.environ.get("RELIT_CACHE") or Path.home() / ".cache" / "relit")


def data_folder(given: str | Path | None = None) -> Path:
    """Folder with `assets` and `envmaps`: `given`, else RELIT_DATA, else shared/data beside the working folder or above it."""
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


def synthesize_item(suite: Suite, item: Item, data: Path, cache: Path, say: Callable[[str], None] = print) -> Path:
    """The capture of one object, rendered if the cache does not hold it. The folder's name carries a hash of all settings."""
    from relit.capture import synthetic

    options = dict(
        views=suite.views,
        test_views=suite.test_views,
        relights=[data / r for r in suite.relights],
        resolution=suite.resolution,
        spp=suite.spp,
        test_spp=suite.test_spp,
        seed=suite.seed,
        roughness=item.roughness,
        metallic=item.metallic,
    )
    settings = synthetic.settings_of(data / item.asset, data / item.light, **options)
    out = cache / "captures" / f"{item.name}-{synthetic.settings_hash(settings)}"
    return synthetic.synthesize_multiview(data / item.asset, data / item.light, out, **options, say=lambda t: say(f"{item.name}: {t}"))


def reconstruct_command(capture: Path, out: Path, quality: str, device: str, seed: int, settings: Sequence[str] = ()) -> list[str]:
    """The command line that is timed."""
    command = [sys.executable, "-m", "relit", "reconstruct", str(capture), "-o", str(out), "--capture", "multiview"]
    command += ["--quality", quality, "--device", device, "--seed", str(seed)]
    for s in settings:
        command += ["--set", s]
    return command


# A process that is started from a large one is charged with that one's memory up to its exec (Linux keeps it in ru_maxrss), and this
# one has rendered before. So a small one starts the command and reads its peak.
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
    """Run a command with its output in `log` and no compiled kernels at hand; (seconds, peak memory in GB).

    Raises UserError (exit code 4) with the end of its output when it fails. The peak is `ru_maxrss` of the command and all that it
    waited for.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    usage = log.with_suffix(".usage.json")
    usage.unlink(missing_ok=True)
    with log.open("wb") as file, tempfile.TemporaryDirectory() as kernels:
        environment = {**os.environ, "DRJIT_CACHE_DIR": kernels}  # empty: compiled kernels of earlier runs would hide the cold start
        launch = [sys.executable, "-S", "-E", "-c", LAUNCHER, str(usage), *command]
        subprocess.run(launch, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False, env=environment)
    if not usage.exists():
        raise UserError("the command was stopped before it could be measured", fix=f"its output: {log}", code=EXIT_FAILED)
    seconds, code, peak = json.loads(usage.read_text())
    if code != 0:
        tail = log.read_text(errors="replace").strip().splitlines()[-12:]
        raise UserError(f"the command ended with code {code}", "\n".join(tail), f"its whole output: {log}", code=EXIT_FAILED)
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes there, KiB on Linux
    return seconds, peak * unit / 1e9


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
    spp: int = 256,
    seed: int = 0,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Synthesize, reconstruct and evaluate every object of a suite, plain and with each ablation.

    assets: folder with `assets` and `envmaps`. objects: names to limit the suite to. ablate: names of ABLATIONS or `key=value`.
    out: folder for the runs and the results, by default a new one in the cache. spp: samples a pixel when the result is rendered.
    Returns {"suite", "quality", "device", "machine", "runs": {variant: {object: {"metrics", ...}}}, "means": {variant: {figure: value}}}.
    """
    from relit.device import use_device
    from relit.evaluate import evaluate

    spec, items = _chosen(suite, objects)
    variants = {"plain": (), **{name: ABLATIONS.get(name, (name,)) for name in _checked_ablations(ablate)}}
    data, store = data_folder(assets), cache_folder(cache)
    used = use_device(device)
    folder = Path(out) if out else store / "runs" / f"{suite}-{quality}-{time.strftime('%Y%m%d-%H%M%S')}"
    captures = {item.name: synthesize_item(spec, item, data, store, say) for item in items}

    result: dict[str, Any] = {
        "suite": suite,
        "quality": quality,
        "device": used,
        "seed": seed,
        "machine": machine(),
        "runs": {},
        "means": {},
    }
    for variant, settings in variants.items():
        result["runs"][variant] = {}
        for name, capture in captures.items():
            run = folder / f"{name}-{variant.replace('=', '_').replace('/', '_')}"
            if run.exists():
                raise UserError("a run of that name is there already", "a resumed run cannot be timed", f"choose another folder: {run}")
            command = reconstruct_command(capture, run, quality, used, seed, settings)
            say(f"{name} ({variant}): {' '.join(command[1:])}")
            seconds, memory = timed(command, folder / "logs" / f"{run.name}.txt")
            say(f"{name} ({variant}): {seconds:.0f} s, {memory:.2f} GB; evaluating")
            entry = evaluate(run, capture, spp=spp)
            cost = {"seconds": seconds, "peak_memory": memory}
            costs = {k: {"value": v, "unit": COST_DEFINITIONS[k][0], "definition": COST_DEFINITIONS[k][1]} for k, v in cost.items()}
            entry["metrics"] = {**costs, **entry["metrics"]}
            result["runs"][variant][name] = {**entry, "run": run.name, "capture": capture.name}
            result["means"][variant] = means(result["runs"][variant])
            _save(result, folder, json_file)
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(table(result))
    say(f"results: {folder / 'results.json'}, {folder / 'results.md'}")
    return result


def means(runs: dict[str, dict]) -> dict[str, float]:
    """Mean over objects of every figure that all of them have."""
    first, *rest = [r["metrics"] for r in runs.values()]
    names = [k for k in first if all(k in r for r in rest)]
    return {k: float(np.mean([first[k]["value"], *(r[k]["value"] for r in rest)])) for k in names}


def bar_of(figure: str, quality: str) -> tuple[str, float] | None:
    """The bar of a figure at a quality: only time and memory have one at draft."""
    if quality == "draft":
        return {"seconds": ("<=", DRAFT_SECONDS), "peak_memory": BARS["peak_memory"]}.get(figure)
    return BARS.get(figure) if quality == "standard" else None


def verdict(figure: str, value: float, quality: str) -> str:
    """'', 'met', or by how much a mean misses its bar."""
    bar = bar_of(figure, quality)
    if bar is None:
        return ""
    missed = bar[1] - value if bar[0] == ">=" else value - bar[1]
    return "met" if missed <= 0 else f"missed by {missed:.3g}"


def markdown(result: dict[str, Any]) -> str:
    """A fragment for benchmarks/RESULTS.md: per variant one table with the objects, the mean, and the bar."""
    lines = [f"Suite `{result['suite']}`, quality `{result['quality']}`, device `{result['device']}`, {result['machine']}.", ""]
    for variant, runs in result["runs"].items():
        lines += [f"### {variant}", "", f"| figure | unit | {' | '.join(runs)} | mean | bar | |", "|---" * (len(runs) + 5) + "|"]
        for figure, mean in result["means"][variant].items():
            values = " | ".join(f"{r['metrics'][figure]['value']:.4g}" for r in runs.values())
            bar, unit = bar_of(figure, result["quality"]), next(iter(runs.values()))["metrics"][figure]["unit"]
            bar_text = f"{bar[0]} {bar[1]:g}" if bar else ""
            lines.append(f"| {figure} | {unit} | {values} | {mean:.4g} | {bar_text} | {verdict(figure, mean, result['quality'])} |")
        lines.append("")
    return "\n".join(lines)


def table(result: dict[str, Any]):
    """A rich Table of the means: one column a variant, one row a figure with a bar or a cost."""
    from rich.table import Table

    out = Table(title=f"{result['suite']}, {result['quality']}, mean of {len(next(iter(result['runs'].values())))} objects")
    out.add_column("figure")
    for variant in result["means"]:
        out.add_column(variant, justify="right")
    out.add_column("bar", justify="right")
    out.add_column("")
    first = next(iter(result["means"].values()))
    for figure, value in first.items():
        bar = bar_of(figure, result["quality"])
        row = [f"{v[figure]:.4g}" if figure in v else "" for v in result["means"].values()]
        out.add_row(figure, *row, f"{bar[0]} {bar[1]:g}" if bar else "", verdict(figure, value, result["quality"]))
    return out


def machine() -> str:
    """Processor, cores this process may use, memory, Python: what a time is worth."""
    name = platform.processor() or platform.machine()
    try:
        info = Path("/proc/cpuinfo").read_text()
        name = next((line.split(":", 1)[1].strip() for line in info.splitlines() if line.startswith("model name")), name)
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1e9:.0f} GB"
    except (OSError, ValueError):
        memory = ""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores{memory}, Python {platform.python_version()}"


def _chosen(suite: str, objects: Sequence[str]) -> tuple[Suite, tuple[Item, ...]]:
    if suite not in SUITES:
        raise UserError(f"unknown suite '{suite}'.{did_you_mean(suite, SUITES)}", fix=f"choose one of: {', '.join(SUITES)}", code=2)
    spec = SUITES[suite]
    names = [item.name for item in spec.items]
    for name in objects:
        if name not in names:
            raise UserError(f"no object '{name}' in this suite.{did_you_mean(name, names)}", fix=f"choose of: {', '.join(names)}", code=2)
    return spec, tuple(item for item in spec.items if not objects or item.name in objects)


def _checked_ablations(ablate: Sequence[str]) -> list[str]:
    for name in ablate:
        if name not in ABLATIONS and "=" not in name:
            raise UserError(
                f"unknown ablation '{name}'.{did_you_mean(name, ABLATIONS)}",
                fix=f"choose of: {', '.join(ABLATIONS) or 'none is named'}; or give key=value, as for `relit reconstruct --set`",
                code=2,
            )
    return list(ablate)


def _save(result: dict[str, Any], folder: Path, json_file: str | Path | None) -> None:
    text = json.dumps(result, indent=1)
    for target in [folder / "results.json", *([Path(json_file)] if json_file else [])]:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, text)
    write_text(folder / "results.md", markdown(result))
