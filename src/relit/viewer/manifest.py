"""What the page is told about a run: one JSON object, with addresses of files or with the files
themselves as data URIs."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from relit.asset.asset import find_asset, read_bounded_json, read_cameras
from relit.conventions import world_from_gl_camera
from relit.errors import UserError
from relit.files import parse_toml, read_json
from relit.log import readable_seconds
from relit.run import read_metrics, read_stages
from relit.scene import Camera

PHOTOS = "photos"  # folder of a run with small copies of its photos
CURVE_POINTS = 200  # of a loss curve in the page
Address = Callable[[Path], str]


def manifest(run: Path, address: Address, *, live: bool, photos: bool = True) -> dict:
    """What viewer/src/main.js reads. run: run folder or asset folder. address: path of a file ->
    what the page fetches.

    live: the page asks `status.json` from time to time. photos: with the small copies of the
    photos.
    Raises UserError for a folder that is neither a run nor an asset, or whose asset is damaged.
    """
    run = Path(run)
    asset = _asset(run)
    if asset is None and not (run / "config.toml").is_file():
        find_asset(run)  # says what was looked for
    config = _config(run)
    found = {} if asset is None else read_bounded_json(asset / "asset.json")
    facts = [
        str(v)
        for v in (
            found.get("capture", config.get("capture")),
            found.get("quality", config.get("quality")),
        )
        if v
    ]
    if isinstance(found.get("seconds"), (int, float)):
        facts.append(readable_seconds(found["seconds"]))
    out: dict = {
        "title": str(config.get("input") or run.resolve().name),
        "facts": facts,
        "live": live,
    }
    out |= {"lights": [], "cameras": [], "asset": None}
    if asset is None:
        return out
    matrix = found.get("world_from_asset")
    if not _is_matrix(matrix):
        raise UserError(
            "world_from_asset in asset.json cannot be used",
            "it is no 4 x 4 matrix",
            f"reconstruct again: {asset}",
        )
    if not (asset / "object.glb").is_file():
        raise UserError(
            "the asset has no object.glb", "the folder is damaged", f"reconstruct again: {asset}"
        )
    instances = _instances(asset)
    out["asset"] = {
        "glb": address(asset / "object.glb"),
        "world_from_asset": matrix,
        "instances": instances,
    }
    copies = photo_files(run) if photos else {}
    cameras = read_cameras(asset / "cameras.json") if (asset / "cameras.json").is_file() else ()
    for name, camera in cameras:
        out["cameras"].append(
            {
                "name": name,
                "photo": address(copies[name]) if name in copies else None,
                **_frame(camera),
            }
        )
    out["lights"] = _lights(asset, cameras, address)
    flash = read_json(asset / "lights" / "flash.json")
    if isinstance(flash, dict) and {"offset", "intensity"} <= flash.keys():
        out["flash"] = {"offset": flash["offset"], "intensity": flash["intensity"]}
    return out


def photo_files(run: Path) -> dict[str, Path]:
    """{name of a photo: its small copy in the run folder}."""
    index = read_json(run / PHOTOS / "index.json")
    files = index.get("photos", {}) if isinstance(index, dict) else {}
    paths = {name: run / PHOTOS / Path(str(file)).name for name, file in files.items()}
    return {name: path for name, path in paths.items() if path.is_file()}


def _asset(run: Path) -> Path | None:
    try:
        return find_asset(run)
    except UserError:
        return None


def _config(run: Path) -> dict:
    try:
        return parse_toml((run / "config.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _is_matrix(m) -> bool:
    return (
        isinstance(m, list)
        and len(m) == 4
        and all(
            isinstance(r, list) and len(r) == 4 and all(isinstance(x, (int, float)) for x in r)
            for r in m
        )
    )


def _frame(camera: Camera) -> dict:
    size = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
    return {**size, "transform_matrix": world_from_gl_camera(camera.world_from_camera).tolist()}


def _lights(asset: Path, cameras, address: Address) -> list[dict]:
    out = []
    for suffix in ("exr", "hdr"):
        path = asset / "lights" / f"environment.{suffix}"
        if path.is_file():
            out.append(
                {"name": "recovered", "file": path.name, "url": address(path), "photo": None}
            )
            break
    for i, (name, _) in enumerate(cameras):
        path = asset / "lights" / f"photo_{i:04d}.exr"
        if path.is_file():
            out.append({"name": f"of {name}", "file": path.name, "url": address(path), "photo": i})
    return out


def _instances(asset: Path) -> list:
    data = read_json(asset / "instances.json")
    listed = data.get("instances", []) if isinstance(data, dict) else []
    poses = [
        i.get("world_from_object")
        for i in listed
        if isinstance(i, dict) and i.get("registered", True)
    ]
    return [m for m in poses if _is_matrix(m)]


# ---------------------------------------------------------------- a run that is not over


def status(run: Path, address: Address) -> dict:
    """Stages, losses, previews and time left of a run, for a page that asks again and again."""
    run = Path(run)
    records, stages = read_metrics(run), read_stages(run)
    done = {s["name"] for s in stages}
    last = records[-1] if records else None
    now = None
    if last and last["stage"] not in done:
        now = {key: last.get(key) for key in ("stage", "step", "of", "seconds")}
        if now["of"] and now["step"]:
            now["left"] = now["seconds"] * (now["of"] / now["step"] - 1)
    previews = sorted(
        (run / "previews").glob("*.jpg"), key=lambda p: p.stat().st_mtime, reverse=True
    )[:6]
    return {
        "running": is_held(run),
        "asset": _asset(run) is not None,
        "stages": [{key: s.get(key) for key in ("name", "title", "seconds")} for s in stages],
        "now": now,
        "curves": curves(records),
        "previews": [
            {"name": p.stem, "url": f"{address(p)}?{p.stat().st_mtime_ns}"} for p in previews
        ],
    }


def curves(records: list[dict]) -> list[dict]:
    """[{stage, name, points: [[step, value], ...]}] of at most CURVE_POINTS points each, in the
    order in which they appear."""
    found: dict[tuple[str, str], list] = {}
    for record in records:
        for key, value in record.items():
            if key not in ("stage", "step", "seconds", "of") and isinstance(value, (int, float)):
                found.setdefault((record["stage"], key), []).append([record["step"], value])
    return [
        {"stage": stage, "name": name, "points": points[:: max(1, -(-len(points) // CURVE_POINTS))]}
        for (stage, name), points in found.items()
    ]


def is_held(run: Path) -> bool:
    """Does a process work in this run folder?"""
    try:
        handle = os.open(run / "lock", os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError:
        return True
    finally:
        os.close(handle)
