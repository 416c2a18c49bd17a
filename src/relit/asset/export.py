"""Other forms of an asset: GLB, OBJ, PLY with vertex colours, a Mitsuba scene folder; its light as
spherical Gaussians."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from relit.asset.asset import find_asset, load_asset, save_textures
from relit.asset.forms import form_of
from relit.asset.mitsuba_plastic import flash_emitter, plastic_bsdf
from relit.asset.obj import write_obj
from relit.conventions import rotate_environment, srgb_from_linear, world_from_mitsuba_camera
from relit.errors import UserError
from relit.geometry.tangents import vertex_normals
from relit.images import write_bytes, write_linear
from relit.lighting.spherical_gaussians import fit_spherical_gaussians, write_lobes
from relit.reference.mitsuba_scene import environment_bitmap
from relit.scene import Asset, Material, Mesh

LOBES = 128  # of the light as spherical Gaussians: SfD Eq. (2)


def export_asset(folder_or_run: str | Path, format: str, out: str | Path) -> list[Path]:
    """Write the asset as `format`: 'glb', 'obj' (with .mtl and textures beside it), 'ply' (vertex
    colours, sRGB), 'mitsuba' (a folder with scene.xml) or 'gaussians' (the environment as LOBES
    spherical Gaussians, a light for `relit relight`). All in the asset frame, but for 'mitsuba',
    which is in the world frame with the first camera and the light.

    Returns the files written. Raises UserError for an unknown format, a wrong suffix, or a folder
    that holds something else.
    """
    out = Path(out)
    if form_of(out, format) == "html":
        raise UserError(
            "a page is no form of the asset's files",
            fix="relit.viewer.export_html.export_html writes it",
        )
    folder = find_asset(folder_or_run)
    asset = load_asset(folder)
    if format == "mitsuba":
        return write_mitsuba(out, asset)
    out.parent.mkdir(parents=True, exist_ok=True)
    if format == "glb":
        if not (out.exists() and out.samefile(folder / "object.glb")):
            shutil.copyfile(folder / "object.glb", out)
        return [out]
    if format == "gaussians":
        return [write_gaussians(out, asset)]
    if format == "obj":
        return write_obj(out, asset.mesh, asset.material)
    write_ply(out, replace(asset.mesh, uvs=None), vertex_colors(asset.mesh, asset.material))
    return [out]


def write_gaussians(path: Path, asset: Asset) -> Path:
    """The recovered environment as LOBES spherical Gaussians in the asset frame. Raises UserError
    where the asset has none."""
    if asset.environment is None:
        raise UserError(
            "the asset has no environment light",
            "its light is a flash, or was not kept",
            "choose another format",
        )
    light = rotate_environment(asset.environment, np.linalg.inv(asset.world_from_asset))
    write_lobes(path, fit_spherical_gaussians(light, LOBES))
    return path


def vertex_colors(mesh: Mesh, material: Material) -> np.ndarray:
    """(V, 3) uint8 sRGB base colour at the vertices (bilinear, textures repeat)."""
    base = np.asarray(material.base_color, np.float32)
    h, w = base.shape[:2]
    uv = np.zeros((len(mesh.vertices), 2)) if mesh.uvs is None else np.asarray(mesh.uvs, np.float64)
    x, y = uv[:, 0] * w - 0.5, uv[:, 1] * h - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = base[y0 % h, x0 % w] * (1 - fx) + base[y0 % h, (x0 + 1) % w] * fx
    bottom = base[(y0 + 1) % h, x0 % w] * (1 - fx) + base[(y0 + 1) % h, (x0 + 1) % w] * fx
    return (np.clip(srgb_from_linear(top * (1 - fy) + bottom * fy), 0, 1) * 255 + 0.5).astype(
        np.uint8
    )


def write_ply(path: Path, mesh: Mesh, colors: np.ndarray | None = None) -> None:
    """Binary PLY with normals, texture coordinates s t (v = 0 at the top row) and optional uint8
    colours (V, 3)."""
    fields = [(k, "<f4") for k in ("x", "y", "z", "nx", "ny", "nz")]
    fields += [("s", "<f4"), ("t", "<f4")] if mesh.uvs is not None else []
    fields += [(k, "u1") for k in ("red", "green", "blue")] if colors is not None else []
    data = np.zeros(len(mesh.vertices), dtype=fields)
    normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh)
    columns = (
        [mesh.vertices, normals]
        + ([mesh.uvs] if mesh.uvs is not None else [])
        + ([colors] if colors is not None else [])
    )
    for (name, _), column in zip(
        fields, np.concatenate([np.asarray(c, np.float64) for c in columns], 1).T, strict=True
    ):
        data[name] = column
    faces = np.zeros(len(mesh.faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, mesh.faces
    names = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(data)}"]
    head += [f"property {names[kind]} {name}" for name, kind in fields]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    write_bytes(path, ("\n".join(head) + "\n").encode() + data.tobytes() + faces.tobytes())


def _matrix(m: np.ndarray) -> str:
    return f'<transform name="to_world"><matrix value="{" ".join(f"{x:.9g}" for x in np.asarray(m).ravel())}"/></transform>'


def write_mitsuba(folder: Path, asset: Asset) -> list[Path]:
    """A folder that `mitsuba scene.xml` renders: object.ply, textures/, environment.exr, the first
    camera, Mitsuba's `principled` BSDF; of a flash capture Mitsuba's `roughplastic` and the flash
    of that camera.

    Two departures from Relit's own renderer, both Mitsuba's: no energy compensation on rough metal,
    no specular map.
    """
    if folder.exists() and (
        not folder.is_dir() or (any(folder.iterdir()) and not (folder / "scene.xml").is_file())
    ):
        raise UserError(
            "there is something else at the place of the Mitsuba scene",
            "it is not overwritten",
            f"choose another folder: {folder}",
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / "object.ply", asset.mesh)
    save_textures(folder / "textures", asset.material)
    raw = '<boolean name="raw" value="true"/>'

    def texture(name: str, extra: str = raw) -> str:
        file = quoteattr(f"textures/{name}.png")
        return f'<texture type="bitmap" name="{name}"><string name="filename" value={file}/>{extra}</texture>'

    bsdf = [
        '<bsdf type="principled">',
        texture("base_color", ""),
        texture("roughness"),
        texture("metallic"),
        f'<float name="eta" value="{asset.material.ior:.6g}"/>',
        "</bsdf>",
    ]
    if asset.flash is not None:
        bsdf = plastic_bsdf(folder, asset.material)
    if asset.material.normal is not None:
        map_ = texture("normal").replace('name="normal"', 'name="normalmap"', 1)
        bsdf = ['<bsdf type="normalmap">', map_, *bsdf, "</bsdf>"]
    lines = [
        '<scene version="3.0.0">',
        '<integrator type="path"><integer name="max_depth" value="6"/></integrator>',
    ]
    if asset.cameras:
        name, c = asset.cameras[0]
        lines += [
            f"<!-- {str(name).replace('--', '- -')} -->",
            '<sensor type="perspective">',
            f'<float name="fov" value="{np.degrees(2 * np.arctan(0.5 * c.width / c.fx)):.9g}"/><string name="fov_axis" value="x"/>',
            f'<float name="principal_point_offset_x" value="{-(c.cx - c.width / 2) / c.width:.9g}"/>',
            f'<float name="principal_point_offset_y" value="{-(c.cy - c.height / 2) / c.height:.9g}"/>',
            _matrix(world_from_mitsuba_camera(c.world_from_camera)),
            f'<film type="hdrfilm"><integer name="width" value="{c.width}"/><integer name="height" value="{c.height}"/>'
            '<rfilter type="box"/></film>',
            '<sampler type="independent"><integer name="sample_count" value="64"/></sampler>',
            "</sensor>",
        ]
    if asset.environment is not None:
        write_linear(folder / "environment.exr", environment_bitmap(asset.environment))
        lines.append(
            '<emitter type="envmap"><string name="filename" value="environment.exr"/></emitter>'
        )
    lines += flash_emitter(asset)
    lines += [
        '<shape type="ply"><string name="filename" value="object.ply"/>',
        _matrix(asset.world_from_asset),
    ]
    lines += ['<bsdf type="twosided">', *bsdf, "</bsdf>", "</shape>", "</scene>"]
    write_bytes(folder / "scene.xml", ("\n".join(lines) + "\n").encode())
    return sorted(p for p in folder.rglob("*") if p.is_file())
