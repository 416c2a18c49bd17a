"""The ceiling of a capture: how near the TRUE asset, rendered by the renderer that fits use under
the true light, comes to the truth pictures.

Where another renderer made the truth, its BRDF, tangents and shading normals differ from ours, and
no fit of the true shape, texture and light reaches more. A constant difference of brightness, which
a fit takes into its base colour, is separated: `gain` brings our pictures to the truth's mean, and
`psnr_masked_gain` is the figure after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from relit.images import read_data
from relit.images.fidelity import MASK, encode, psnr
from relit.scene import Camera
from relit.synthesize.renderers import DEPTHS, TrueObject

DEFINITION = (
    "mean over test views of the PSNR in dB of sRGB-encoded pictures clipped to [0, 1]: the true "
    "asset in Relit's renderer under the true light against the truth pictures; psnr: whole frame "
    f"on black; psnr_masked: pixels of true coverage >= {MASK}; gain: truth / ours, per channel, "
    "mean linear radiance inside the mask; psnr_masked_gain: psnr_masked after gain"
)
LEAST_SPP = 256  # samples a pixel of our pictures, as many as `relit evaluate` takes
SEED = 700_000  # apart from the seeds of the truth pictures, whose noise must not cancel


def ceiling_under(
    thing: TrueObject, light: Path, pictures: Sequence[tuple[Path, Camera]], spp: int, seed: int
) -> dict[str, object]:
    """{"psnr", "psnr_masked", "psnr_masked_gain": dB, "gain": [3]} under one light.

    light: EXR of (H, W, 3) radiance, world frame. pictures: (EXR of linear RGBA, premultiplied
    on black, its camera) of each test view. spp: samples a pixel of the truth; ours have as many,
    and at least LEAST_SPP. The noise of both is part of the figures.
    """
    from relit.reference.mitsuba_scene import build_scene, render

    scene = build_scene(
        thing.mesh, thing.material, thing.world_from_asset, read_data(light)[..., :3]
    )
    pairs = []
    for i, (file, camera) in enumerate(pictures):
        ours = render(
            scene,
            camera,
            spp=max(spp, LEAST_SPP),
            seed=seed + SEED + i,
            max_depth=DEPTHS["relit"],
        )
        pairs.append((ours[..., :3], read_data(file)))
    insides = [truth[..., 3] >= MASK for _, truth in pairs]
    seen = [(a[k], t[k][..., :3]) for (a, t), k in zip(pairs, insides, strict=True) if k.any()]
    gain = np.ones(3)
    if seen:
        ours, theirs = (
            np.concatenate(values).mean(0, dtype=np.float64) for values in zip(*seen, strict=True)
        )
        gain = theirs / np.maximum(ours, 1e-9)
    figures = [
        (
            psnr(encode(a), encode(t[..., :3])),
            psnr(encode(a), encode(t[..., :3]), k),
            psnr(encode(a * gain), encode(t[..., :3]), k),
        )
        for (a, t), k in zip(pairs, insides, strict=True)
    ]
    whole, masked, with_gain = np.nanmean(np.array(figures), 0)
    return {
        "psnr": float(whole),
        "psnr_masked": float(masked),
        "psnr_masked_gain": float(with_gain),
        "gain": [float(g) for g in gain],
    }


def ceilings(
    thing: TrueObject,
    lights: dict[str, tuple[Path, Sequence[tuple[Path, Camera]]]],
    spp: int,
    seed: int,
    say: Callable[[str], None],
) -> dict[str, object]:
    """`ceiling_under` of each light by name, with "definition"; a line of the log each."""
    out: dict[str, object] = {"definition": DEFINITION}
    for name, (light, pictures) in lights.items():
        figures = out[name] = ceiling_under(thing, light, pictures, spp, seed)
        say(
            f"ceiling under {name}: {figures['psnr']:.1f} dB, {figures['psnr_masked']:.1f} inside "
            f"the mask, {figures['psnr_masked_gain']:.1f} after a constant gain"
        )
    return out
