"""A rough plastic of varying width as a Mitsuba scene describes it.

Mitsuba's `roughplastic` has one alpha for the whole object. So a few of them, of evenly spaced
alphas, are blended by `blendbsdf`: with t the place of alpha between the least (0) and the greatest
(LEVELS - 1), level k and all further ones are mixed by clip(t - k, 0, 1), which is linear
interpolation between the two nearest levels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.images import write_data, write_linear
from relit.lighting.flash import flash_position
from relit.scene import Asset, Material

LEVELS = 5
DIFFUSE = "diffuse_albedo.exr"
EVEN = 0.02  # a relative range of alpha below which one plastic is enough


def plastic_bsdf(folder: Path, material: Material) -> list[str]:
    """Lines of the BSDF; writes textures/specular.exr and the blend's weights. The diffuse albedo
    is there already."""
    diffuse = "base_color.png" if material.diffuse is None else DIFFUSE
    specular = (
        np.ones((1, 1), np.float32)
        if material.specular is None
        else np.asarray(material.specular, np.float32)
    )
    specular = specular[..., None].repeat(3, -1) if specular.ndim == 2 else specular
    write_linear(folder / "textures" / "specular.exr", specular)
    alpha = np.square(np.asarray(material.roughness, np.float32))
    low, high = (float(v) for v in np.percentile(alpha, [1, 99]))
    count = LEVELS if high > low * (1 + EVEN) else 1
    levels = np.linspace(low, high, count) if count > 1 else [float(alpha.mean())]
    place = (alpha - low) / max(high - low, 1e-9) * (count - 1)
    lines = _plastic(levels[-1], material.ior, diffuse)
    for k in reversed(range(count - 1)):
        write_data(folder / "textures" / f"wider_{k}.png", np.clip(place - k, 0, 1))
        file = f'<string name="filename" value="textures/wider_{k}.png"/>'
        weight = f'<texture type="bitmap" name="weight">{file}<boolean name="raw" value="true"/></texture>'
        lines = [
            '<bsdf type="blendbsdf">',
            weight,
            *_plastic(levels[k], material.ior, diffuse),
            *lines,
        ]
        lines.append("</bsdf>")
    return lines


def _plastic(alpha: float, ior: float, diffuse: str) -> list[str]:
    return [
        '<bsdf type="roughplastic">',
        '<string name="distribution" value="ggx"/>',
        f'<float name="alpha" value="{alpha:.6g}"/><float name="int_ior" value="{ior:.6g}"/><float name="ext_ior" value="1"/>',
        f'<texture type="bitmap" name="diffuse_reflectance"><string name="filename" value="textures/{diffuse}"/></texture>',
        '<texture type="bitmap" name="specular_reflectance"><string name="filename" value="textures/specular.exr"/>'
        '<boolean name="raw" value="true"/></texture>',
        "</bsdf>",
    ]


def flash_emitter(asset: Asset) -> list[str]:
    """Lines of the flash where it stands for the first camera."""
    if asset.flash is None or not asset.cameras:
        return []
    x, y, z = flash_position(asset.flash, asset.cameras[0][1])
    colour = ", ".join(f"{v:.8g}" for v in asset.flash.intensity)
    place = f'<point name="position" x="{x:.8g}" y="{y:.8g}" z="{z:.8g}"/>'
    return [f'<emitter type="point">{place}<rgb name="intensity" value="{colour}"/></emitter>']
