"""Reference renderings under the flash: Mitsuba's path tracer, a rough plastic with textures, one
point light per photo.

`relit_rough_plastic` is `materials.rough_plastic` as a Mitsuba plugin: Mitsuba's own `roughplastic`
has one alpha for the whole object. Where all its textures are constant the two agree
(tests/materials/test_rough_plastic.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import move_points, scale_of
from relit.errors import UserError
from relit.geometry.tangents import vertex_tangents
from relit.lighting.flash import flash_position
from relit.materials import rough_plastic
from relit.reference.bsdf import shading_normal
from relit.reference.mitsuba_scene import (
    as_picture,
    mitsuba_mesh,
    mitsuba_texture,
    moved_mesh,
    sample_sums,
    unit_ball,
)
from relit.scene import Camera, Flash, Material, Mesh

PLUGIN = "relit_rough_plastic"


@dataclass(frozen=True)
class FlashScene:
    """mi_scene: object and one point light of intensity 1, moved and scaled so that the object
    fills the unit ball. textures: by name.
    unit_from_world: (4, 4), scale and translation. parameters: Mitsuba's parameters of the
    light."""

    mi_scene: Any
    textures: dict
    unit_from_world: np.ndarray
    parameters: Any


def register_flash() -> str:
    """Make the plugin known to the present Mitsuba variant; returns its name."""
    _register(mi.variant())
    return PLUGIN


@cache
def _register(variant: str) -> None:
    class RoughPlastic(mi.BSDF):
        """See the module's text. Only the front reflects, as with Mitsuba's."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.base_color = props.get_texture("base_color", 0.5)
            self.roughness = props.get_texture("roughness", 0.5)
            self.specular = props.get_texture("specular", 1.0)
            self.normalmap = (
                props.get_texture("normalmap") if props.has_property("normalmap") else None
            )
            self.coat = rough_plastic.Coat(float(props.get("int_ior", rough_plastic.IOR)))
            flags = mi.BSDFFlags
            self.m_components = [flags.DiffuseReflection | flags.GlossyReflection | flags.FrontSide]
            self.m_flags = self.m_components[0]

        def surface(self, si, active=True):
            diffuse = mi.Color3f(self.base_color.eval(si, active))
            return rough_plastic.Plastic(
                diffuse,
                self.specular.eval_1(si, active),
                dr.square(self.roughness.eval_1(si, active)),
            )

        def _seen(self, si, active):
            return active & (mi.Frame3f.cos_theta(si.wi) > 0)

        def eval(self, ctx, si, wo, active=True):
            n = shading_normal(si, self.normalmap, active)
            value = rough_plastic.evaluate_plastic(
                self.surface(si, active), self.coat, n, si.wi, wo
            )
            return dr.select(self._seen(si, active) & (mi.Frame3f.cos_theta(wo) > 0), value, 0)

        def pdf(self, ctx, si, wo, active=True):
            n = shading_normal(si, self.normalmap, active)
            return dr.select(
                self._seen(si, active),
                rough_plastic.plastic_pdf(self.surface(si, active), n, si.wi, wo),
                0,
            )

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            m, n = self.surface(si, active), shading_normal(si, self.normalmap, active)
            bs = mi.BSDFSample3f()
            bs.wo = rough_plastic.sample_plastic(m, n, si.wi, sample1, sample2)
            bs.pdf = dr.select(active, rough_plastic.plastic_pdf(m, n, si.wi, bs.wo), 0)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            ok = self._seen(si, active) & (bs.pdf > 0) & (mi.Frame3f.cos_theta(bs.wo) > 0)
            weight = rough_plastic.evaluate_plastic(m, self.coat, n, si.wi, bs.wo) / dr.select(
                ok, bs.pdf, 1
            )
            return bs, dr.select(ok, weight, 0)

        def traverse(self, cb):
            for name in ("base_color", "roughness", "specular"):
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def to_string(self):
            return f"{PLUGIN}[]"

    mi.register_bsdf(PLUGIN, lambda props: RoughPlastic(props))


def build_flash_scene(mesh: Mesh, material: Material, world_from_asset=None) -> FlashScene:
    """The scene in the world frame. material: its `diffuse` is the diffuse albedo, or base_color
    where that is None; specular the factor on the coat, alpha = roughness²."""
    if material.normal is not None and mesh.uvs is None:
        raise UserError(
            "the material has a normal map but the mesh has no texture coordinates",
            fix="give it uvs, or drop the map",
        )
    world_from_asset = (
        np.eye(4) if world_from_asset is None else np.asarray(world_from_asset, np.float64)
    )
    specular = (
        np.ones((1, 1), np.float32)
        if material.specular is None
        else np.asarray(material.specular, np.float32)
    )
    t = {
        "base_color": mitsuba_texture(
            material.base_color if material.diffuse is None else material.diffuse, color=True
        ),
        "roughness": mitsuba_texture(material.roughness),
        "specular": mitsuba_texture(specular.mean(-1) if specular.ndim == 3 else specular),
        "normalmap": None
        if material.normal is None
        else mitsuba_texture(np.asarray(material.normal, np.float32) * 0.5 + 0.5),
    }
    d = {
        "type": register_flash(),
        "int_ior": float(material.ior),
        **{k: v for k, v in t.items() if v is not None},
    }
    unit_from_world = unit_ball(mesh, world_from_asset)
    unit = moved_mesh(mesh, unit_from_world @ world_from_asset)
    light = {
        "type": "point",
        "position": [0.0, 0.0, 3.0],
        "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "object": mitsuba_mesh(
                unit, mi.load_dict(d), None if t["normalmap"] is None else vertex_tangents(unit)
            ),
            "light": light,
        }
    )
    return FlashScene(scene, t, unit_from_world, mi.traverse(scene))


def render_flash(
    scene: FlashScene,
    camera: Camera,
    flash: Flash,
    spp: int = 64,
    *,
    seed: int = 0,
    max_depth: int = 4,
    where=None,
    progress=None,
) -> np.ndarray:
    """(H, W, 4) float32 linear premultiplied radiance and coverage. max_depth: longest path in
    edges (2 = direct light only). where,
    progress: see `mitsuba_scene.sample_sums`; 0 elsewhere."""
    if max_depth < 2 or spp < 1:
        raise ValueError("max_depth must be at least 2 and spp at least 1")
    s = scale_of(scene.unit_from_world)
    scene.parameters["light.position"] = mi.Point3f(
        move_points(scene.unit_from_world, flash_position(flash, camera)).tolist()
    )
    scene.parameters.update()
    path = mi.load_dict(
        {"type": "path", "max_depth": max_depth, "rr_depth": 1000, "hide_emitters": True}
    )

    def sample(ray, _, sampler):
        colour, hit, _ = path.sample(scene.mi_scene, sampler, ray)
        return [*colour, dr.select(hit, mi.Float(1), 0)]

    out = sample_sums(scene, camera, spp, seed, sample, where, progress) / spp
    out[:, :3] *= np.asarray(flash.intensity) * s * s
    return as_picture(out, camera, where)


def render_maps(
    scene: FlashScene, camera: Camera, spp: int = 16, seed: int = 0
) -> dict[str, np.ndarray]:
    """Means over the covered part of each pixel, 0 where nothing is hit: diffuse (H, W, 3),
    specular, alpha (width of the lobe), coverage (H, W), normal (H, W, 3) unit, WORLD frame."""
    t = scene.textures

    def sample(ray, *_):
        si = scene.mi_scene.ray_intersect(ray)
        hit = si.is_valid()
        normal = si.to_world(mi.Vector3f(shading_normal(si, t["normalmap"], hit)))
        base = mi.Color3f(t["base_color"].eval(si, hit))
        values = [
            *base,
            t["specular"].eval_1(si, hit),
            dr.square(t["roughness"].eval_1(si, hit)),
            *normal,
            mi.Float(1),
        ]
        return [dr.select(hit, v, 0) for v in values]

    total = sample_sums(scene, camera, spp, seed, sample)
    mean = (
        (total / np.maximum(total[:, 8:], 1e-9))
        .reshape(camera.height, camera.width, 9)
        .astype(np.float32)
    )
    length = np.linalg.norm(mean[..., 5:8], axis=-1, keepdims=True)
    coverage = (total[:, 8] / spp).reshape(camera.height, camera.width).astype(np.float32)
    return {
        "diffuse": mean[..., :3],
        "specular": mean[..., 3],
        "alpha": mean[..., 4],
        "normal": mean[..., 5:8] / np.maximum(length, 1e-9),
        "coverage": coverage,
    }
