"""Photos beside what the asset shows in their place: the pairs of the report, with what each shows
in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from relit.conventions import linear_from_srgb
from relit.evaluate.metrics import encode, psnr
from relit.evaluate.photos import shrunk_to_camera
from relit.reference.photographed import as_photographed
from relit.scene import Asset, Camera, Capture, Pixels


@dataclass(frozen=True)
class PhotoAndRender:
    """photo: (H, W, 3) linear, multiplied with its mask where the render has no background to
    compare. render: (H, W, 4) premultiplied.
    where: (H, W) bool, the pixels that `caption` gives the PSNR of."""

    photo: np.ndarray
    render: np.ndarray
    where: np.ndarray
    caption: str

    @property
    def difference(self) -> np.ndarray:
        """(H, W, 3) four times the difference of the sRGB pictures where the object is drawn,
        linear."""
        seen = self.render[..., 3:] > 0.5
        return (
            linear_from_srgb(
                np.clip(4 * np.abs(encode(self.photo) - encode(self.render[..., :3])), 0, 1)
            )
            * seen
        )


def kind_of(asset: Asset) -> str:
    """'flash', 'duplicates', 'collection' or 'multiview', by what the asset holds."""
    if asset.flash is not None:
        return "flash"
    if any(i.registered for i in asset.instances):
        return "duplicates"
    return "collection" if asset.lights else "multiview"


TITLES = {
    "multiview": "Photos and renders under the recovered light",
    "flash": "Photos and renders under the recovered flash",
    "duplicates": "Photo and render of all registered objects",
    "collection": "Photos and renders, each under the light recovered for it",
}
SHOWN = {
    "multiview": "the object under the recovered environment",
    "flash": "the object (rough plastic) under the recovered flash, which stands by the camera of each photo, inter-reflections included",
    "duplicates": "all registered objects on the recovered ground under the recovered environment, which itself is not drawn",
    "collection": "the object under the light that was recovered for this very photo, its exposure and white balance included",
}


def pairs(
    asset: Asset, capture: Capture, *, views: int, held_out: int, side: int, spp: int
) -> Iterator[PhotoAndRender]:
    """At most `views` photos of the fit and `held_out` ones that it has not seen, evenly spread, at
    most `side` pixels a side."""
    photos = {p.name: p for p in (*capture.photos, *capture.held_out)}
    kind, show = kind_of(asset), as_photographed(asset)
    chosen, unseen = choice(asset, capture, views, held_out)
    first = asset.cameras[0][0] if asset.cameras else ""
    for name, camera, tail in (
        *((n, c, "") for n, c in chosen),
        *((n, c, " (held out)") for n, c in unseen),
    ):
        pixels, small = photos[name].load(), shrunk_camera(camera, side)
        photo, render = resized(pixels.rgb, small), show(name, small, spp=spp)
        where, over = render[..., 3] > 0.5, "where the object is drawn"
        if kind == "duplicates":
            where, over = registered_pixels(asset, pixels, small, render, name == first)
        elif pixels.mask is not None:
            photo = photo * resized(pixels.mask, small)[..., None]
        quality = (
            f"{psnr(encode(render[..., :3]), encode(photo), where):.1f} dB {over}"
            if where.any()
            else "the object is not in view"
        )
        yield PhotoAndRender(photo, render, where, f"{name}{tail}: {quality}")


def choice(asset: Asset, capture: Capture, views: int, held_out: int) -> tuple[list, list]:
    """(name, camera) of the photos of the fit that are shown, and of those set aside. Of a
    collection the latter were given a camera and a light by the run; cameras that its format knows
    for them stand in another frame."""
    names = {p.name for p in (*capture.photos, *capture.held_out)}
    aside = set(asset.meta.get("held_out", ()))
    known = [c for c in asset.cameras if c[0] in names]
    unseen = [c for c in known if c[0] in aside]
    if not asset.lights:
        unseen += [(p.name, p.camera) for p in capture.held_out if p.camera is not None]
    return evenly_spread([c for c in known if c[0] not in aside], views), evenly_spread(
        unseen, held_out
    )


def registered_pixels(
    asset: Asset, pixels: Pixels, camera: Camera, render: np.ndarray, first: bool
) -> tuple[np.ndarray, str]:
    """(H, W) bool of the registered objects in a photo, and what that is in words. The asset knows
    instances by their labels in the first photo; in others, objects count where they are labelled
    and something is drawn."""
    labels = pixels.labels if pixels.labels is not None else np.ones(pixels.rgb.shape[:2], np.int32)
    registered = [i.label for i in asset.instances if i.registered and i.photo == 0]
    count = f"{sum(i.registered for i in asset.instances)} of {len(asset.instances)} objects"
    if first and pixels.labels is not None:
        own = np.isin(labels, registered)
        return resized(
            own.astype(np.float32), camera
        ) > 0.5, f"over the photo's pixels of the {count} that are registered"
    drawn = resized((labels > 0).astype(np.float32), camera) > 0.5
    return drawn & (
        render[..., 3] > 0.5
    ), f"over the photo's pixels of objects, where something is drawn ({count} are registered)"


def evenly_spread(items, count: int) -> list:
    """At most `count` items, evenly spread."""
    items = list(items)
    return (
        [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]
        if items
        else []
    )


def shrunk_camera(camera: Camera, side: int) -> Camera:
    """The camera of a picture of at most `side` pixels a side."""
    k = side / max(camera.width, camera.height)
    return (
        camera
        if k >= 1
        else camera.resized(max(1, round(camera.width * k)), max(1, round(camera.height * k)))
    )


def resized(image: np.ndarray, camera: Camera) -> np.ndarray:
    """A linear picture at the size of `camera`, by the mean over areas."""
    return shrunk_to_camera(np.ascontiguousarray(image, dtype=np.float32), camera)  # pyright: ignore[reportReturnType]
