"""`relit inspect INPUT --edit`: the page where masks are painted and boxes drawn, kept beside the
capture."""

from __future__ import annotations

import json
from pathlib import Path
from urllib.parse import parse_qs

import cv2
import numpy as np

from relit.capture.corrections import (
    corrected_masks,
    corrected_sphere,
    forget_mask,
    save_mask,
    save_sphere,
    sphere_from_boxes,
)
from relit.errors import UserError
from relit.images import encode_jpeg
from relit.images.opencv import decode_bytes
from relit.masks.grabcut import box_cut
from relit.scene import Capture, Photo
from relit.viewer.photos import shrunk
from relit.viewer.serve import Server, open_port

SIDE = 1280  # pixels, longest side of what is painted on


def correction_server(capture: Capture, port: int = 0) -> Server:
    """A server of the page for this capture; what is saved there counts when the capture is opened
    the next time."""
    photos = (*capture.photos, *capture.held_out)
    root = capture.folder
    may_cut = (
        capture.kind != "duplicates"
    )  # one box knows one object, and the mask of a pile is of all

    def index(query: str) -> Photo:
        i = int(parse_qs(query)["i"][0])
        if not 0 <= i < len(photos):
            raise LookupError(f"there is no photo {i}")
        return photos[i]

    def state() -> dict:
        done = corrected_masks(root)
        listed = [
            {
                "name": p.name,
                "corrected": p.name in done,
                **dict(zip(("w", "h"), _size(p), strict=True)),
            }
            for p in photos
        ]
        sphere = corrected_sphere(root) or capture.sphere
        circles = (
            [_circle(p, sphere) for p in photos] if sphere is not None else [None] * len(photos)
        )
        facts = [f"{len(photos)} photos", capture.format]
        offered = {"boxes": capture.has_cameras, "cut": may_cut}
        return {
            "mode": "edit",
            "title": root.name,
            "facts": facts,
            "photos": listed,
            "circles": circles,
            **offered,
        }

    def photo(query: str) -> tuple[bytes, str]:
        return encode_jpeg(shrunk(index(query).load().rgb, SIDE)), "image/jpeg"

    def mask(query: str) -> tuple[bytes, str]:
        return _png(_mask_of(index(query), root)), "image/png"

    def keep_mask(body: bytes, query: str) -> dict:
        p = index(query)
        if not body:
            forget_mask(root, p)
            return {"corrected": False}
        save_mask(root, p, _decoded(body, _size(p)))
        return {"corrected": True}

    def keep_boxes(body: bytes, _: str) -> dict:
        boxes = []
        for entry in json.loads(body):
            p = index(f"i={int(entry['i'])}")
            if p.camera is None:
                raise UserError(
                    "boxes need cameras",
                    "without them a box says nothing about the place",
                    "reconstruct first, or give cameras",
                )
            w, h = _size(p)
            x0, y0, x1, y1 = (
                float(v) * s
                for v, s in zip(
                    entry["box"], (p.camera.width / w, p.camera.height / h) * 2, strict=True
                )
            )
            boxes.append((p.camera, (x0, y0, x1, y1)))
        sphere = sphere_from_boxes(boxes)
        save_sphere(root, sphere)
        return {"centre": sphere.centre.tolist(), "radius": sphere.radius}

    def keep_cut(body: bytes, _: str) -> dict:
        entry = json.loads(body)
        p = index(f"i={int(entry['i'])}")
        if not may_cut:
            raise UserError(
                "a pile has no single box",
                "its mask shows all objects",
                "paint, or change the label image",
            )
        save_mask(root, p, mask_in_box(p, entry["box"]))
        return {"corrected": True}

    posts, pictures = (
        {"mask": keep_mask, "boxes": keep_boxes, "cut": keep_cut},
        {"photo.jpg": photo, "mask.png": mask},
    )
    return open_port(lambda: Server(root, {"manifest.json": state}, posts, pictures, port), port)


def mask_in_box(p: Photo, box: list) -> np.ndarray:
    """(H, W) in [0, 1]: what GrabCut finds in a box (x0, y0, x1, y1), pixels of what is painted on.
    Raises UserError."""
    w, h = _size(p)
    x0, y0, x1, y1 = np.clip([float(v) for v in box], 0, (w, h, w, h))
    if not (min(x1 - x0, y1 - y0) >= 4 and (x1 - x0) * (y1 - y0) < 0.98 * w * h):
        raise UserError(
            "the box is too small, or holds the whole photo",
            "what lies outside tells what is not the object",
            "draw it closely round it",
        )
    mask = box_cut(shrunk(p.load().rgb, SIDE), (x0, y0, x1, y1))
    if not mask.any():
        raise UserError(
            "nothing stands out in the box",
            "object and surroundings have the same colours",
            "paint the mask",
        )
    return mask


def _size(p: Photo) -> tuple[int, int]:
    s = min(1.0, SIDE / max(p.width, p.height))
    return max(1, round(p.width * s)), max(1, round(p.height * s))


def _circle(p: Photo, sphere) -> list[float] | None:
    """Centre and radius, pixels of what is painted on, of the object sphere."""
    if p.camera is None:
        return None
    c = p.camera.resized(*_size(p))
    x, y, z = c.project(sphere.centre)
    return [float(x), float(y), float(c.fx * sphere.radius / z)] if z > 1e-9 else None


def _mask_of(p: Photo, root: Path) -> np.ndarray:
    """The present mask at the size that is painted on: the corrected one, else the photo's own,
    else white."""
    from relit.images import read_data

    path = corrected_masks(root).get(p.name)
    mask = read_data(path) if path is not None else p.load().mask
    w, h = _size(p)
    if mask is None:
        return np.ones((h, w), np.float32)
    mask = mask if mask.ndim == 2 else mask[..., 0]
    return cv2.resize(np.ascontiguousarray(mask, np.float32), (w, h), interpolation=cv2.INTER_AREA)


def _png(mask: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".png", (np.clip(mask, 0, 1) * 255 + 0.5).astype(np.uint8))
    if not ok:
        raise ValueError("the mask could not be encoded")
    return data.tobytes()


def _decoded(body: bytes, size: tuple[int, int]) -> np.ndarray:
    """A posted PNG as (h, w) in [0, 1]. Raises UserError for anything but a PNG of the size that
    was sent."""
    w, h = size
    head = body[:8] == b"\x89PNG\r\n\x1a\n" and len(body) > 24
    if not head or (int.from_bytes(body[16:20], "big"), int.from_bytes(body[20:24], "big")) != (
        w,
        h,
    ):
        raise UserError(f"the mask is no PNG of {w} x {h} pixels")
    mask = decode_bytes(body, cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise UserError("the mask cannot be decoded")
    return mask.astype(np.float32) / 255
