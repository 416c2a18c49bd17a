"""report.html: one file that shows a run. Pictures are data URIs, curves are inline SVG; nothing is
fetched and no script runs.

Reads the run folder only: asset, metrics.jsonl, stage records, evaluation.json where `relit
evaluate` or the demo wrote one.
"""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import numpy as np

from relit.asset.asset import load_asset
from relit.conventions import linear_from_srgb, rotate_environment
from relit.files import parse_toml, read_json, write_text
from relit.images import encode_jpeg
from relit.log import readable_bytes, readable_seconds
from relit.reference.flash_scene import build_flash_scene, render_maps
from relit.reference.mitsuba_scene import build_scene, render, render_channels
from relit.reference.photographed import lit_scene
from relit.relight import orbit, orbit_camera
from relit.report.comparison import SHOWN, TITLES, evenly_spread, kind_of, pairs, shrunk_camera
from relit.report.curves import ball_of, bars, camera_plot, curve
from relit.run import read_metrics, read_stages
from relit.scene import Asset, Capture
from relit.synthesize.procedural import evening, studio

SIDE = 240  # pixels, longer side of a picture
VIEWS = 4  # training photos that are compared
HELD_OUT = 2  # photos that the fit has not seen
STILLS = 12  # of the turntable
# samples a pixel of the turntable; the report is for looking, figures come from `relit evaluate`
SPP = 16
SPP_COMPARED = 48  # ... of what stands beside a photo
BACKDROP = 0.18  # linear grey behind the object

STYLE = f"""
body{{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1460px;padding:0 1em;color:#222;background:#fafafa}}
h1{{font-size:1.6em;margin-bottom:.1em}}h2{{font-size:1.15em;margin:2em 0 .5em;border-bottom:1px solid #ccc}}
.row{{display:flex;flex-wrap:wrap;gap:10px;margin-bottom:10px}}figure{{margin:0}}figcaption{{font-size:12px;color:#555}}
img{{display:block;border-radius:3px}}svg{{background:#fff;border:1px solid #ddd;border-radius:3px}}
table{{border-collapse:collapse;font-size:14px}}td,th{{padding:3px 12px 3px 0;text-align:left;vertical-align:top}}
td.n{{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}}code{{background:#eee;padding:1px 4px}}
.turn{{overflow:hidden;border-radius:3px}}.turn img{{max-width:none;animation:turn 4s steps({STILLS}) infinite}}
@keyframes turn{{to{{transform:translateX(-100%)}}}}
"""


def write_report(run: str | Path, capture: Capture | None = None) -> Path:
    """Write RUN/report.html. capture: the photos to compare with (without it that part is left
    out). Call `use_device` first."""
    run = Path(run)
    asset = load_asset(run)
    parts = [  # as the asset stands in its folder: what is shown is what is shipped
        _head(run, asset),
        _section(TITLES[kind_of(asset)], _comparison(asset, capture)),
        _section("Material and shape", _channels(asset)),
        _section("Light", _light(asset)),
        _section("Another light", _turntables(asset)),
        _section("Figures against the truth", _figures(run)),
        _section("Cameras", camera_plot([c for _, c in asset.cameras], ball_of(asset))),
        _section("Losses", _losses(run)),
        _section("Time and memory", _costs(run)),
        _section("Textures", _textures(asset)),
        _section("Notes", _notes(run, asset)),
        _section("Files", _files(run)),
    ]
    title = escape(_title(run))
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    write_text(run / "report.html", head + "".join(parts) + "</html>\n")
    return run / "report.html"


# ---------------------------------------------------------------- sections


def _head(run: Path, asset: Asset) -> str:
    meta, config = asset.meta, _config(run)
    seconds = sum(s["seconds"] for s in read_stages(run))
    facts = [
        f"{len(asset.cameras)} cameras",
        *(
            [
                f"{sum(i.registered for i in asset.instances)} of {len(asset.instances)} objects registered"
            ]
            if asset.instances
            else []
        ),
        ", ".join(
            f"{key} {value}"
            for key, value in {**meta, **config}.items()
            if key in ("quality", "seed", "device")
        ),
        f"{len(asset.mesh.faces):,} triangles",
        "textures {1}x{0}".format(*asset.material.base_color.shape[:2]),
        readable_seconds(seconds),
    ]
    return f"<h1>{escape(_title(run))}</h1><p>{' &middot; '.join(escape(f) for f in facts)}</p>"


def _comparison(asset: Asset, capture: Capture | None) -> str:
    if capture is None:
        return ""
    shown = pairs(asset, capture, views=VIEWS, held_out=HELD_OUT, side=SIDE, spp=SPP_COMPARED)
    rows = [
        _figure(np.concatenate([p.photo, p.render[..., :3], p.difference], axis=1), p.caption)
        for p in shown
    ]
    what = f"Photo; render: {SHOWN[kind_of(asset)]}; difference x 4."
    how = f"{SPP_COMPARED} samples a pixel. PSNR of sRGB pictures at this size, noise included."
    return f"<div class=row>{''.join(rows)}</div><p>{what} {how}</p>" if rows else ""


def _channels(asset: Asset) -> str:
    rows = []
    flash = asset.flash is not None
    scene = (
        build_flash_scene(asset.mesh, asset.material, asset.world_from_asset)
        if flash
        else lit_scene(asset, ground=False)
    )
    for name, camera in evenly_spread(asset.cameras, 3)[
        :2
    ]:  # the first and the middle one: the last often stands beside the first
        small = shrunk_camera(camera, SIDE)
        c = render_maps(scene, small) if flash else render_channels(scene, small, spp=16)  # pyright: ignore[reportArgumentType]
        a = c["coverage" if flash else "alpha"][..., None]
        if flash:
            shown = {
                "diffuse albedo": c["diffuse"],
                "specular albedo": _grey(c["specular"]),
                "roughness": _grey(np.sqrt(c["alpha"])),
            }
        else:
            shown = {
                "base colour": c["albedo"],
                "roughness": _grey(c["roughness"]),
                "metallic": _grey(c["metallic"]),
            }
        shown["normal (world)"] = linear_from_srgb(np.clip(0.5 * c["normal"] + 0.5, 0, 1))
        colour = next(iter(shown))
        cells = "".join(
            _figure(v * a + BACKDROP * (1 - a), k if k != colour else f"{k}, {name}")
            for k, v in shown.items()
        )
        rows.append(f"<div class=row>{cells}</div>")
    return "".join(rows)


def _grey(plane: np.ndarray) -> np.ndarray:
    """(H, W) numbers from 0 to 1 -> (H, W, 3) linear greys that look even."""
    return linear_from_srgb(np.repeat(np.clip(plane, 0, 1)[..., None], 3, 2))


def _light(asset: Asset) -> str:
    if asset.flash is not None:
        offset, intensity = (
            ", ".join(f"{v:.4g}" for v in values)
            for values in (asset.flash.offset, asset.flash.intensity)
        )
        where = "x right, y down, z forward of the camera, in the units of cameras.json"
        return f"<p>A point light that moves with the camera: offset ({offset}), {where}; radiant intensity ({intensity}).</p>"
    if asset.environment is None:
        return "<p>The asset holds no environment map.</p>"
    e = asset.environment
    level = float(np.mean(e)) or 1.0
    whole = "the middle one of all photos' lights, " if asset.lights else ""
    shown = [
        (0.3 / level, f"{whole}mean radiance drawn as .3"),
        (0.02 / level, "15 times darker: what is bright"),
    ]
    cells = "".join(_figure(_scaled(e * k, 480), text) for k, text in shown)
    peak = f"Mean {level:.3g}, largest {float(e.max()):.3g}, in units of the photos' linear pixels. Middle of the picture: +Z, top: +Y."
    own = evenly_spread(
        [(name, light) for (name, _), light in zip(asset.cameras, asset.lights, strict=False)],
        VIEWS,
    )
    means = [float(np.mean(light)) or 1.0 for _, light in own]
    each = "".join(
        _figure(
            _scaled(light * (0.3 / mean), SIDE), f"light of {name}, mean {mean:.3g} drawn as .3"
        )
        for (name, light), mean in zip(own, means, strict=True)
    )
    return (
        f"<div class=row>{cells}</div>"
        + (f"<div class=row>{each}</div>" if each else "")
        + f"<p>{peak}</p>"
    )


def _turntables(asset: Asset) -> str:
    cameras = [camera for _, camera in orbit(asset, STILLS, SIDE)]
    cameras += [
        orbit_camera(asset, 0, elevation, SIDE) for elevation in (90, -90)
    ]  # the side below is often a guess, and easily overlooked
    cells = []
    lights = {"a studio of formulas": studio(64), "an evening of formulas": evening(64)}
    for name, light in lights.items():
        upright = rotate_environment(light, asset.world_from_asset)  # its top over the object's top
        scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, upright)
        stills = [render(scene, c, spp=SPP) for c in cameras]
        covered = np.concatenate([s[s[..., 3] > 0.5][:, :3].ravel() for s in stills])
        k = 0.9 / max(float(np.percentile(covered, 99)), 1e-6) if covered.size else 1.0
        stills = [s[..., :3] * k + BACKDROP * (1 - s[..., 3:]) for s in stills]
        picture = f'<img alt="" src="{_uri(np.concatenate(stills[:STILLS], axis=1))}">'
        frame = f'<div class=turn style="width:{SIDE}px;height:{SIDE}px">{picture}</div>'
        cells.append(f"<figure>{frame}<figcaption>{escape(name)}</figcaption></figure>")
        some = np.concatenate([*(stills[STILLS * i // 3] for i in range(3)), *stills[STILLS:]], 1)
        cells.append(_figure(_scaled(some, 5 * 200), "stills of it; from above; from below"))
    plastic = (
        "<p>With the metallic-roughness material of object.glb, which stands for the rough plastic.</p>"
        if asset.flash
        else ""
    )
    return f"<div class=row>{''.join(cells)}</div>{plastic}"


def _figures(run: Path) -> str:
    found = read_json(run / "evaluation.json")
    if not found:
        return "<p>No truth was given. <code>relit evaluate RUN --truth DIR</code> measures against a synthetic capture or the photos.</p>"
    rows = [
        (name, f"{e['value']:.4g}", e["unit"], e["definition"])
        for name, e in found["metrics"].items()
    ]
    return _table(("figure", "value", "unit", "definition"), rows)


def _losses(run: Path) -> str:
    stages: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for record in read_metrics(run):
        for key, value in record.items():
            if key not in ("stage", "step", "of", "seconds") and isinstance(value, (int, float)):
                stages.setdefault(record["stage"], {}).setdefault(key, []).append(
                    (record["step"], value)
                )
    plots = [
        curve(f"{stage}: {name}", points)
        for stage, named in stages.items()
        for name, points in named.items()
        if len(points) > 1
    ]
    return f"<div class=row>{''.join(plots)}</div>" if plots else "<p>No losses were recorded.</p>"


def _costs(run: Path) -> str:
    stages = read_stages(run)
    rows = [
        (s["title"], readable_seconds(s["seconds"]), readable_bytes(s["peak_memory"]))
        for s in stages
    ]
    table = _table(("stage", "time", "peak memory"), rows)
    return f"<div class=row>{table}{bars([(s['title'], s['seconds']) for s in stages])}</div>"


def _textures(asset: Asset) -> str:
    m = asset.material
    shown = {
        "base colour": m.base_color,
        "roughness": _grey(m.roughness),
        "metallic": _grey(m.metallic),
    }
    if m.specular is not None:
        shown["specular"] = _grey(
            m.specular if np.ndim(m.specular) == 2 else np.mean(m.specular, -1)
        )
    if m.normal is not None:
        shown["normal (tangent)"] = linear_from_srgb(
            np.clip(0.5 * np.asarray(m.normal) + 0.5, 0, 1)
        )
    return f"<div class=row>{''.join(_figure(_scaled(v, SIDE), k) for k, v in shown.items())}</div>"


def _notes(run: Path, asset: Asset) -> str:
    notes = read_json(run / "stages" / "asset" / "notes.json") or []
    said = [line.split("note: ", 1)[1].strip() for line in read_log(run) if "  note: " in line]
    lines = list(dict.fromkeys([*(str(n) for n in notes), *said])) or ["Nothing was remarked."]
    versions = asset.meta.get("versions")
    if isinstance(versions, dict):
        lines.append("made with " + ", ".join(f"{k} {v}" for k, v in versions.items()))
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def read_log(run: Path) -> list[str]:
    """The lines of the run's log, none where there is no log."""
    file = run / "log.txt"
    return file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []


def _files(run: Path) -> str:
    files = sorted(p for p in (run / "asset").rglob("*") if p.is_file())
    return _table(
        ("file", "size"),
        [(str(p.relative_to(run)), readable_bytes(p.stat().st_size)) for p in files],
    )


# ---------------------------------------------------------------- pieces


def _scaled(image: np.ndarray, width: int) -> np.ndarray:
    import cv2

    height = max(1, round(image.shape[0] * width / image.shape[1]))
    how = cv2.INTER_AREA if width <= image.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(
        np.ascontiguousarray(image, dtype=np.float32), (width, height), interpolation=how
    )


def _uri(linear: np.ndarray) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(np.nan_to_num(linear))).decode(
        "ascii"
    )


def _figure(linear: np.ndarray, caption: str) -> str:
    h, w = linear.shape[:2]
    text = escape(caption)
    picture = f'<img alt="{text}" width={w} height={h} src="{_uri(linear)}">'
    return f'<figure>{picture}<figcaption style="max-width:{w}px">{text}</figcaption></figure>'


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """The second and third columns hold numbers."""
    lines = ["".join(f"<th>{escape(h)}</th>" for h in head)]
    lines += [
        "".join(
            f"<td{' class=n' if i in (1, 2) else ''}>{escape(c)}</td>" for i, c in enumerate(row)
        )
        for row in rows
    ]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _section(title: str, body: str) -> str:
    return f"<h2>{escape(title)}</h2>{body}" if body else ""


def _config(run: Path) -> dict:
    try:
        return parse_toml((run / "config.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _title(run: Path) -> str:
    return f"Relit: {_config(run).get('input', run.resolve().name)}"
