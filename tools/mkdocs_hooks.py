"""MkDocs hooks: pages of the site that lie outside docs/, and the pages of the API reference."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {  # page of the site: file of the repository
    "index.md": "README.md",
    "guide.md": "docs/README.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "SECURITY.md": "SECURITY.md",
    "RESULTS.md": "benchmarks/RESULTS.md",
    "benchmarks.md": "benchmarks/README.md",
}
API = {  # page: (title, modules)
    "relit": (
        "API: reconstruct, load, use",
        ("relit.api", "relit.reconstruction", "relit.job", "relit.capture.open", "relit.errors"),
    ),
    "data": (
        "API: data",
        ("relit.scene", "relit.recipe", "relit.conventions", "relit.run", "relit.records"),
    ),
    "fit": (
        "API: fit",
        (
            "relit.fit.multiview.recipe",
            "relit.fit.flash.recipe",
            "relit.fit.duplicates.recipe",
            "relit.fit.collection.recipe",
            "relit.fit.passes.volume",
            "relit.fit.passes.surface",
            "relit.fit.passes.losses",
            "relit.fit.passes.optimiser",
        ),
    ),
    "rendering": (
        "API: rendering, materials, lights",
        (
            "relit.rendering.march",
            "relit.rendering.transport",
            "relit.rendering.transport_flash",
            "relit.materials.brdf",
            "relit.materials.rough_plastic",
            "relit.lighting.environment",
            "relit.lighting.flash",
            "relit.lighting.per_photo",
            "relit.lighting.spherical_gaussians",
        ),
    ),
}


def on_files(files, config):
    """Add the pages of OUTSIDE and API."""
    for page, source in OUTSIDE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(
            File.generated(config, page, content=_relinked(text, (ROOT / source).parent, "."))
        )
    for name, (title, modules) in API.items():
        text = "\n\n".join([f"# {title}", *(f"::: {m}" for m in modules)])
        files.append(File.generated(config, f"api/{name}.md", content=text + "\n"))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links of pages in docs/ to files outside docs/."""
    path = ROOT / "docs" / page.file.src_uri
    folder = str(Path(page.file.src_uri).parent)
    return _relinked(markdown, path.parent, folder) if path.is_file() else markdown


def _relinked(text: str, folder: Path, at: str) -> str:
    """Links to files of the repository as links of the site; a file that has no page becomes plain
    text. folder: of the file that holds the text. at: folder of its page in the site."""
    page_of = {(ROOT / source).resolve(): page for page, source in OUTSIDE.items()}

    def link(match: re.Match) -> str:
        label, target, anchor = match[1], match[2], match[3] or ""
        path = (folder / target).resolve()
        if "://" in target or not path.exists():
            return match[0]
        if path in page_of:
            return f"[{label}]({os.path.relpath(page_of[path], at)}{anchor})"
        docs = ROOT / "docs"
        if path.is_relative_to(docs):
            return f"[{label}]({os.path.relpath(path.relative_to(docs), at)}{anchor})"
        return f"`{path.relative_to(ROOT).as_posix()}`"

    return re.sub(r"\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)", link, text)
