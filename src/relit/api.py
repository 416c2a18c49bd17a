"""Relit from Python and in notebooks; reads like the command line.

import relit
capture = relit.open_capture("photos/")
asset = relit.reconstruct("photos/", "runs/mug", quality="draft")
asset.relight("sunset.hdr")            # pictures
asset.export("mug.glb")
asset                                  # in a notebook: the object, to be turned
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path

from relit.scene import Asset


@dataclass(frozen=True)
class AssetFolder:
    """An asset on disk: what `reconstruct` returns and `load` opens. run: the run folder or the
    asset folder."""

    run: Path

    @cached_property
    def asset(self) -> Asset:
        """Mesh, material, light and cameras as arrays."""
        from relit.asset.asset import load_asset

        return load_asset(self.run)

    @property
    def folder(self) -> Path:
        """Where object.glb stands."""
        from relit.asset.asset import find_asset

        return find_asset(self.run)

    def relight(
        self,
        light: str | Path,
        out: str | Path | None = None,
        *,
        cameras: str | Path = "orbit:1",
        device: str = "auto",
        **options,
    ) -> list:
        """Pictures under another light (`relit relight`). out: a folder or FILE.mp4, then the files
        are returned; None returns PIL images.

        light: lat-long .hdr or .exr. cameras: 'capture', 'orbit:N' or a transforms.json. options:
        spp, size, rotate, albedo_scale, ...
        """
        from PIL import Image

        from relit.device import use_device
        from relit.relight import relight

        use_device(device)
        if out is not None:
            return relight(self.run, light, out, cameras=cameras, **options)
        with tempfile.TemporaryDirectory(prefix="relit-") as folder:
            files = relight(self.run, light, Path(folder) / "pictures", cameras=cameras, **options)
            return [Image.open(f).copy() for f in files if f.suffix == ".png"]

    def export(self, out: str | Path, format: str | None = None) -> Path:
        """Another form of the asset (`relit export`): glb, obj, ply, mitsuba, gaussians (its light
        alone, .json) or html, by default told by the ending. Returns the file."""
        from relit.asset.export import export_asset
        from relit.asset.forms import form_of
        from relit.viewer.export_html import export_html

        out = Path(out)
        kind = form_of(out, format)
        if kind == "html":
            export_html(self.run, out)
        else:
            export_asset(self.run, kind, out)
        return out

    def evaluate(self, truth: str | Path, *, device: str = "auto", **options) -> dict:
        """Every figure that a known truth allows (`relit evaluate`)."""
        from relit.device import use_device
        from relit.evaluate.dispatch import evaluate

        use_device(device)
        return evaluate(self.run, truth, **options)

    def _repr_html_(self) -> str:
        """The page of the asset in a frame, where it is built; else what the asset is."""
        from relit.errors import UserError
        from relit.viewer.export_html import data_uri
        from relit.viewer.manifest import manifest
        from relit.viewer.page import page_with

        try:
            page = page_with(manifest(Path(self.run), data_uri, live=False, photos=False))
        except UserError as error:
            return f"<pre>{escape(repr(self))}\n{escape(str(error))}</pre>"
        style = "width:100%;height:460px;border:1px solid #888;border-radius:4px"
        return f'<iframe style="{style}" sandbox="allow-scripts" srcdoc="{escape(page, quote=True)}"></iframe>'


def reconstruct(input: str | Path, out: str | Path, **options) -> AssetFolder:
    """Photos into a relightable asset (`relit reconstruct`); the same call again resumes.

    options: those of `relit.reconstruction.reconstruct`: capture, quality, device, seed, masks,
    sphere, max_side, focal, settings, ...
    """
    from relit.reconstruction import reconstruct as job

    return AssetFolder(job(input, out, **options).parent)


def load(run: str | Path) -> AssetFolder:
    """The asset of a run folder, or an asset folder. Raises UserError when there is none."""
    from relit.asset.asset import find_asset

    find_asset(run)
    return AssetFolder(Path(run))


def inspect(input: str | Path, **job) -> dict:
    """What an input was recognised as and what is odd about it (`relit inspect --json`). job:
    quality, masks, sphere, max_side, capture."""
    from relit.job import Job
    from relit.preflight.inspect import inspect_input

    return inspect_input(input, Job(**job))
