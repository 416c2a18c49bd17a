"""Writes docs/licences.md: every dependency of Relit with its version and licence, read from what
is installed.

.venv/bin/python tools/licences.py
"""

from __future__ import annotations

import json
import re
import sys
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.files import parse_toml  # noqa: E402

HEAD = """# Dependencies and their licences

Written by `tools/licences.py` from the installed packages. Relit itself: Apache-2.0 (LICENSE).
No code of these packages is copied into the repository. The page in the wheel contains three.js and
three-mesh-bvh, with their notices at its top.
"""

# What their projects say, where the distribution does not or is an extra that need not be
# installed.
STATED = {
    "OpenEXR": "BSD-3-Clause",
    "pillow-heif": "BSD-3-Clause; its wheel carries libheif (LGPL-3.0)",
    "rawpy": "MIT; its wheel carries LibRaw (LGPL-2.1 or CDDL-1.0)",
    "onnxruntime": "MIT",
    "bpy": "GPL-3.0; Relit runs it in a process of its own and never imports it",
    "imageio-ffmpeg": "BSD-2-Clause; its wheel carries ffmpeg (GPL)",
}


def licence(name: str) -> tuple[str, str]:
    """(version, licence) of an installed distribution."""
    data = metadata.metadata(name)
    text = data.get("License-Expression") or ""
    trove = [
        c.split(" :: ")[-1] for c in data.get_all("Classifier") or [] if c.startswith("License ::")
    ]
    text = (
        text
        or "; ".join(t for t in trove if t != "OSI Approved")
        or (data.get("License") or "not stated").splitlines()[0]
    )
    text = STATED.get(name, text)
    return data["Version"], re.sub(r"\s+", " ", text)[:80]


def requirements(lines: list[str]) -> list[str]:
    return [re.split(r"[\s<>=!~;\[]", line, maxsplit=1)[0] for line in lines]


def closure(names: list[str]) -> list[str]:
    """The installed distributions that `names` need, themselves included, extras left out."""
    found: dict[str, str] = {}
    left = list(names)
    while left:
        name = left.pop()
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key in found:
            continue
        try:
            found[key] = metadata.metadata(name)["Name"]
        except metadata.PackageNotFoundError:
            continue
        left += requirements([r for r in metadata.requires(name) or [] if "extra ==" not in r])
    return sorted(found.values(), key=str.lower)


def table(rows: list[tuple[str, str, str]]) -> str:
    return (
        "\n".join(
            [
                "| package | version | licence |",
                "|---|---|---|",
                *(f"| {' | '.join(r)} |" for r in rows),
            ]
        )
        + "\n"
    )


def page() -> str:
    project = parse_toml((ROOT / "pyproject.toml").read_text())["project"]
    core = closure(requirements(project["dependencies"]))
    parts = [HEAD, "## Needed to run\n", table([(n, *licence(n)) for n in core])]
    parts += ["## Optional\n"]
    for extra, names in project["optional-dependencies"].items():
        rows = []
        for name in requirements(names):
            try:
                rows.append((name, *licence(name)))
            except metadata.PackageNotFoundError:
                rows.append((name, "any", STATED[name]))
        parts.append(f"`pip install relit[{extra}]`\n\n{table(rows)}")
    rows = []
    for folder, kinds in (
        ("viewer", ("dependencies", "devDependencies")),
        ("tools/validator", ("dependencies",)),
    ):
        wanted = json.loads((ROOT / folder / "package.json").read_text())
        for kind in kinds:
            for name, version in wanted.get(kind, {}).items():
                about = json.loads(
                    (ROOT / folder / "node_modules" / name / "package.json").read_text()
                )
                use = (
                    "in the page"
                    if kind == "dependencies" and folder == "viewer"
                    else "for building and tests"
                )
                rows.append((f"{name} ({use})", version, str(about.get("license", "see its page"))))
    parts += ["## npm\n", table(rows)]
    parts.append(
        "## From the system\n\nlibLLVM 17 or newer (Apache-2.0 with LLVM exceptions); the NVIDIA driver for `--device cuda`.\n"
    )
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "licences.md").write_text(page(), encoding="utf-8")
