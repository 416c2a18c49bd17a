"""`relit export --format html`: the page with the asset inside, one file that opens from an e-mail
and fetches nothing."""

from __future__ import annotations

import base64
from pathlib import Path

from relit.files import disk_errors, write_text
from relit.viewer.manifest import manifest
from relit.viewer.page import page_with

TYPES = {
    ".glb": "model/gltf-binary",
    ".exr": "image/x-exr",
    ".hdr": "image/vnd.radiance",
    ".jpg": "image/jpeg",
    ".png": "image/png",
}


def data_uri(path: Path) -> str:
    """A file as a data URI."""
    return f"data:{TYPES[path.suffix.lower()]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def export_html(run: str | Path, out: str | Path, *, photos: bool = True) -> Path:
    """Write the page of a finished run as one file. photos: with the small copies of the photos.
    Returns the file."""
    out = Path(out)
    from relit.asset.asset import find_asset

    find_asset(run)
    text = page_with(manifest(Path(run), data_uri, live=False, photos=photos))
    with disk_errors(out.parent):
        write_text(out, text)
    return out
