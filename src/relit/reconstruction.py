"""The main job: an input folder into a run folder with its asset and report. `relit
reconstruct`."""

from __future__ import annotations

import dataclasses
import json
import platform
import shutil
from collections.abc import Iterable
from pathlib import Path

from relit import __version__
from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.files import write_text
from relit.job import (
    Cost,
    Job,
    capture_kind,
    check_memory,
    estimate,
    input_digests,
    open_as,
    plan_job,
    recipe_of,
)
from relit.log import readable_bytes, readable_seconds
from relit.run import Run, StageReached
from relit.scene import Capture
from relit.settings import with_pairs, with_values


def reconstruct(
    input: str | Path,
    out: str | Path,
    *,
    device: str = "auto",
    pairs: Iterable[str] = (),
    settings: dict | None = None,
    config: str | Path | None = None,
    overwrite: bool = False,
    report: bool = True,
    force: bool = False,
    until: str = "",
    **flags,
) -> Path:
    """Photos -> `out`/asset; returns the asset folder. Giving the same call again resumes or finds
    it done.

    flags: the fields of `Job`; None means not given. config: a TOML file whose values stand where
    no flag was given. pairs: 'key=value'
    texts, settings: {key: value}, both for the fields of the recipe's options (for example
    `relit.fit.multiview.recipe.MultiviewOptions`). report: write report.html as well. force: keep a result that its own evidence does not
    bear out, which is refused (4) otherwise. until: stop after this stage of the recipe and return the
    run folder; the same call without it goes on.
    Raises UserError for bad input (3), a failed reconstruction (4), a lack of the machine (5),
    unknown settings (2).
    """
    from relit.device import use_device

    job, from_file = plan_job(flags, config)
    capture_kind(job.capture)  # a kind that is not there is refused before anything is read
    check_folders_apart(Path(input), Path(out))
    chosen = use_device(device)
    capture, kind = open_as(Path(input), job)
    recipe = recipe_of(kind)
    options = with_values(recipe.options(job.quality), from_file, f"--config {config}")
    options = with_values(with_pairs(options, pairs), settings or {}, "settings")
    if until and until not in recipe.stages:
        raise UserError(
            f"no stage '{until}' in the recipe {recipe.name}.{did_you_mean(until, recipe.stages)}",
            fix=f"choose of: {', '.join(recipe.stages)}",
            code=EXIT_USAGE,
        )
    cost = estimate(capture, job, kind, options)
    check_memory(cost)
    record = {
        "input": Path(input).resolve().name,
        **dataclasses.asdict(job),
        "capture": kind,
        "settings": dataclasses.asdict(options),
    }
    with Run.open(out, record, resume=not overwrite, inputs=input_digests(capture)) as run:
        run.force, run.until = force, until
        asset_folder = run.folder / "asset"
        finished = run.done("asset") and (asset_folder / "asset.json").is_file()
        reported = run.done("report") and (run.folder / "report.html").is_file()
        if finished and (reported or not report):
            run.say(f"this run is complete: {asset_folder}")
            return asset_folder
        _begin(run, capture, chosen, cost)
        if not finished and getattr(options, "check_light", False) and not run.done("volume"):
            from relit.preflight.light import check_flash_light

            check_flash_light(capture, run.say)
        given = capture  # photos whose cameras are not found are left out of what follows
        if not recipe.finds_cameras:
            capture = with_cameras(capture, run, job)
        if not finished:
            try:
                asset = recipe.run(capture, run, options, job.seed)
            except StageReached as reached:
                run.say(
                    f"stopped after the stage '{reached}'; the same command without --until goes on"
                )
                return run.folder
            unchanged(run, given)
            _save(run, asset, capture, kind, job, chosen)
        if not (run.folder / "photos" / "index.json").is_file():
            from relit.viewer.photos import write_photos

            write_photos(run.folder, capture)  # for `relit view`
        if report:
            from relit.report.page import write_report

            with run.stage("report", title="report"):
                write_report(run.folder, capture)
            run.say(f"report: {run.folder / 'report.html'}")
        return asset_folder


def unchanged(run: Run, capture: Capture) -> None:
    """Raises UserError when an input file is not what it was when the run was begun: stages read
    the photos anew."""
    before, now = json.loads((run.folder / "inputs.json").read_text()), input_digests(capture)
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if changed:
        raise UserError(
            f"{len(changed)} input files changed while the run was at work: {', '.join(changed[:5])}",
            "the asset would mix the old and the new",
            f"put the old files back and give the same command again, or --overwrite to begin anew: {run.folder}",
        )


def check_folders_apart(input: Path, out: Path) -> None:
    """Raises UserError when the run folder would lie in the input or hold it: the run's pictures
    would be taken for photos."""
    a, b = input.resolve(), out.resolve()
    if a == b or b.is_relative_to(a) or a.is_relative_to(b):
        why = "the run's pictures would be mixed with the photos"
        raise UserError(
            "the run folder and the input lie in one another", why, f"choose another -o: {out}"
        )


def _begin(run: Run, capture: Capture, device: str, cost: Cost) -> None:
    run.log.note(f"relit {__version__}, Python {platform.python_version()}, {platform.platform()}")
    run.say(
        f"{len(capture.photos)} photos ({capture.format}), {'cameras given' if capture.has_cameras else 'no cameras'}, on {device}"
    )
    for note in capture.notes:
        run.say(f"note: {note}")
    free = shutil.disk_usage(run.folder).free
    if free < cost.disk:
        run.say(
            f"note: {readable_bytes(free)} of disk are free, a run takes up to {readable_bytes(cost.disk)}"
        )
    run.say(
        f"about {readable_seconds(cost.seconds)} and {readable_bytes(cost.memory)} of memory on 2 cores"
    )


def with_cameras(capture: Capture, run: Run, job: Job) -> Capture:
    """The capture with cameras: its own, or found from the photos (stage 'cameras', kept for a
    resume)."""
    if capture.has_cameras:
        return capture
    from relit.cameras.sfm import find_cameras, kept_cameras
    from relit.capture.open import with_grabcut

    focals = _decoded_focals(capture, job.focal)

    # the finder keeps its own model in the stage's folder, so a second call after a stop is cheap
    if run.done("cameras"):
        folder = run.folder / "stages" / "cameras"
        kept = kept_cameras(capture, seed=job.seed, workdir=folder, focals=focals)
        if (
            kept is None
            # found anew they would stand in a frame of their own, and what later stages have kept would
            # not fit
        ):
            why = "the model was damaged or removed; later stages were computed from it"
            fix = f"give the same command with --overwrite to begin anew: {folder}"
            raise UserError("the cameras that this run has found cannot be read", why, fix)
        return with_grabcut(kept[0]) if job.masks == "grabcut" else kept[0]
    with run.stage("cameras", title="cameras from photos") as stage:
        found, verdict = find_cameras(
            capture, seed=job.seed, workdir=stage.folder, focals=focals, say=run.say
        )
    run.say(str(verdict))
    return (
        with_grabcut(found) if job.masks == "grabcut" else found
    )  # it is seeded by the object sphere, so it had to wait for the cameras


def _decoded_focals(capture: Capture, focal: float | None) -> list[float] | None:
    """--focal is in pixels of the files; the finder wants it in those of each photo as decoded
    (--max-side shrinks large ones more)."""
    if focal is None:
        return None
    from relit.images import read_header

    headers = [read_header(capture.root / photo.name) for photo in capture.photos]
    return [
        focal * max(p.width, p.height) / max(h.width, h.height)
        for p, h in zip(capture.photos, headers, strict=True)
    ]


def _save(run: Run, asset, capture: Capture, kind: str, job: Job, device: str) -> None:
    from relit.asset.asset import save_asset

    stages = run.stages()
    meta = {
        **asset.meta,
        "capture": kind,
        "quality": job.quality,
        "seed": job.seed,
        "device": device,
        "versions": versions(),
        "stages": {
            s["name"]: {"seconds": s["seconds"], "peak_memory": s["peak_memory"]} for s in stages
        },
        "seconds": round(sum(s["seconds"] for s in stages), 1),
        "peak_memory": max((s["peak_memory"] for s in stages), default=0),
        "inputs": json.loads((run.folder / "inputs.json").read_text()),
    }
    from relit.evaluate.roundtrip import write_own_renders

    with run.stage("asset", title="asset") as stage:
        write_own_renders(stage.folder, asset)  # what the file formats are judged against
        save_asset(run.folder / "asset", dataclasses.replace(asset, meta=meta))
        write_text(stage.folder / "notes.json", json.dumps(list(capture.notes)))


def versions() -> dict[str, str]:
    """What made the asset."""
    from importlib.metadata import version

    return {
        "relit": __version__,
        "python": platform.python_version(),
        **{n: version(n) for n in ("mitsuba", "drjit", "numpy")},
    }
