"""The object of a flash capture in its room: what lights it, and the materials that a rough plastic
does not describe.

With the file's own material the object is Mitsuba's `principled`, and the truth maps are those of
the plastic that reflects as much at normal incidence: diffuse albedo base (1 - metallic), specular
albedo F0 over the plastic's, alpha = roughness^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.scene import Camera, Flash, Material, Mesh

if TYPE_CHECKING:
    from relit.reference.flash_scene import FlashScene
    from relit.reference.mitsuba_scene import Scene

PAINTS = ("own", "dark", "bright")
DARK = 0.1  # factor on the base colour: black rubber has .03, a mean texture .3
BRIGHT = 0.3  # of the distance to white that is left: white paint has .8
MATERIALS = ("plastic", "own")
DIELECTRIC_F0 = 0.04  # of glTF's default index of refraction, 1.5
GLIMPSE = 100  # pixels a side of the views that the ambient light is measured in
GLIMPSE_VIEWS, GLIMPSE_SPP = 6, 32


@dataclass(frozen=True)
class FlashRoom:
    """object: lit by the flash alone. maps: the same with the plastic whose maps are the truth.
    ambient: the object under the room's light, radiance already scaled; None for a dark room."""

    object: FlashScene
    maps: FlashScene
    ambient: Scene | None = None

    def photo(
        self, camera: Camera, flash: Flash, spp: int, seed: int, max_depth: int
    ) -> np.ndarray:
        """(H, W, 4) float32 linear premultiplied radiance and coverage."""
        from relit.reference.flash_scene import render_flash
        from relit.reference.mitsuba_scene import render

        rgba = render_flash(self.object, camera, flash, spp, seed=seed, max_depth=max_depth)
        if self.ambient is None:
            return rgba
        around = render(self.ambient, camera, spp=spp, seed=seed + 400_000, max_depth=max_depth)
        return np.concatenate([rgba[..., :3] + around[..., :3], rgba[..., 3:]], -1)

    def under(
        self,
        light: Path,
        share: float,
        shown: tuple[Sequence[tuple[str, Camera]], Flash],
        max_depth: int,
    ) -> FlashRoom:
        """The room under a lat-long light whose mean radiance on the object is `share` of the
        flash's. shown: (name, camera) of the photos, and the flash. Raises UserError for a black
        light."""
        from relit.images import read_image
        from relit.reference.mitsuba_scene import render

        environment = read_image(light).rgb
        cameras, flash = shown
        scene = self._lit_by(environment)
        count = min(GLIMPSE_VIEWS, len(cameras))
        chosen = np.unique(np.linspace(0, len(cameras) - 1, count).round().astype(int))
        by_flash, by_room = [], []
        for i in chosen:
            small = cameras[i][1].resized(GLIMPSE, GLIMPSE)
            own = self.photo(small, flash, GLIMPSE_SPP, int(i), max_depth)
            inside = own[..., 3] > 0.99
            room = render(scene, small, spp=GLIMPSE_SPP, seed=int(i), max_depth=max_depth)
            by_flash.append(own[..., :3][inside].mean())
            by_room.append(room[..., :3][inside].mean())
        level = float(np.mean(by_room))
        if not level > 0:
            raise UserError("the light of the room is black", fix=f"choose another: {light}")
        factor = share * float(np.mean(by_flash)) / level
        return replace(self, ambient=self._lit_by((environment * factor).astype(np.float32)))

    def _lit_by(self, environment: np.ndarray) -> Scene:
        """The object under radiance (H, W, 3), lat-long, world frame, without the flash."""
        import mitsuba as mi

        from relit.reference.mitsuba_scene import Scene, environment_bitmap

        light = {"type": "envmap", "bitmap": mi.Bitmap(environment_bitmap(environment))}
        parts = {f"part_{k}": s for k, s in enumerate(self.object.mi_scene.shapes())}
        scene = mi.load_dict({"type": "scene", **parts, "environment": light})
        return Scene(scene, self.object.textures, self.object.unit_from_world, None)


def room_light(given, relights: Sequence, ambient: float) -> Path | None:
    """The light of the room among what a synthesizer was given; None for a dark one. Raises
    UserError where light and share do not fit."""
    lights = [Path(f) for f in ([given] if isinstance(given, (str, Path)) else given or ())]
    if not 0 <= ambient <= 1:
        raise UserError(f"ambient = {ambient} is outside [0, 1]", "it is a share", code=EXIT_USAGE)
    if relights or (lights and not ambient):
        raise UserError(
            "a flash capture has no light but the flash",
            fix="leave out --light and --relight, or give the share of the light with --ambient",
            code=EXIT_USAGE,
        )
    if ambient and len(lights) != 1:
        raise UserError(
            "the light of the room is not known", fix="give one file to --light", code=EXIT_USAGE
        )
    if lights and not lights[0].is_file():
        raise UserError(f"no light file: {lights[0]}", fix="give an existing HDR or EXR file")
    return lights[0] if lights else None


def painted(material: Material, paint: str) -> Material:
    """The material in one of PAINTS. Raises UserError for another."""
    _check_word("paint", paint, PAINTS)
    base = np.asarray(material.base_color, np.float32)
    if paint == "own":
        return material
    return replace(material, base_color=DARK * base if paint == "dark" else 1 - BRIGHT * (1 - base))


def plastic_coat(material: Material) -> Material:
    """The rough plastic of the module's text. Maps of different sizes are sampled to the largest."""
    import cv2

    from relit.materials.rough_plastic import IOR

    base, roughness, metallic = (
        np.asarray(m, np.float32)
        for m in (material.base_color, material.roughness, material.metallic)
    )
    side = max((m.shape[:2] for m in (base, roughness, metallic)), key=lambda s: s[0] * s[1])
    base, roughness, metallic = (
        cv2.resize(m, side[::-1], interpolation=cv2.INTER_LINEAR)
        for m in (base, roughness, metallic)
    )
    own_f0 = ((IOR - 1) / (IOR + 1)) ** 2
    f0 = DIELECTRIC_F0 * (1 - metallic) + base.mean(-1) * metallic
    return replace(
        material,
        base_color=base * (1 - metallic[..., None]),
        roughness=roughness,
        metallic=np.zeros((1, 1), np.float32),
        specular=(f0 / own_f0).astype(np.float32),
        ior=IOR,
    )


def flash_room(
    thing: tuple[Mesh, Material, np.ndarray], plastic: Material, material: str
) -> FlashRoom:
    """A dark room. thing: mesh, its own material, world_from_asset (4, 4). plastic: what the truth
    maps show. material: of MATERIALS. Raises UserError for another."""
    from relit.reference.flash_scene import build_flash_scene

    _check_word("material", material, MATERIALS)
    mesh, own, placed = thing
    maps = build_flash_scene(mesh, plastic, placed)
    return FlashRoom(
        maps if material == "plastic" else principled_flash_scene(mesh, own, placed), maps
    )


def principled_flash_scene(mesh: Mesh, material: Material, placed: np.ndarray) -> FlashScene:
    """`build_flash_scene` with Mitsuba's `principled` in the place of the package's plastic."""
    import mitsuba as mi

    from relit.reference.flash_scene import FlashScene
    from relit.reference.mitsuba_scene import build_scene

    dark = build_scene(mesh, material, placed, None, bsdf="principled")
    light = {
        "type": "point",
        "position": [0.0, 0.0, 3.0],
        "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
    }
    parts = {f"part_{k}": s for k, s in enumerate(dark.mi_scene.shapes())}
    scene = mi.load_dict({"type": "scene", **parts, "light": light})
    return FlashScene(scene, dark.textures, dark.unit_from_world, mi.traverse(scene))


def _check_word(what: str, word: str, known: Sequence[str]) -> None:
    if word not in known:
        raise UserError(
            f"unknown {what} '{word}'.{did_you_mean(word, known)}",
            fix=f"choose one of: {', '.join(known)}",
            code=EXIT_USAGE,
        )
