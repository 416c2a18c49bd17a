"""The direction of imports, read from the sources: a module imports only what stands left of it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from relit.files import parse_toml

SOURCE = Path(__file__).resolve().parents[1] / "src" / "relit"
# A module may import modules of lower rows, and of its own row where the row is one package or says so.
ROWS = [
    ["errors", "conventions", "__init__"],
    ["images", "log", "files", "run", "settings", "device"],
    ["scene"],
    ["capture", "masks", "cameras"],
    ["geometry", "materials", "lighting"],
    ["rendering"],
    ["fit"],
    ["asset"],
    ["relight", "edit", "evaluate", "viewer"],
    ["plan", "preflight", "reconstruct", "demo", "benchmark", "doctor", "verbs", "cli", "api", "__main__"],
]
LEVEL = {name: i for i, row in enumerate(ROWS) for name in row}
BUILT_UPON = ("asset", "relight", "edit", "evaluate", "viewer")  # read asset folders only: never import `fit`
# what capture/synthetic*.py may import: they render the truth, so they alone reach up
GROUND_TRUTH = {"asset", "rendering", "materials", "geometry"}
USERS_OF_SYNTHETIC = {"benchmark", "demo", "cli", "verbs"}


def modules():
    return sorted(SOURCE.rglob("*.py"))


def part_of(path: Path) -> str:
    """First name below the package: 'capture/idr.py' -> 'capture', 'run.py' -> 'run'."""
    relative = path.relative_to(SOURCE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def imported(tree: ast.AST) -> set[tuple[str, ...]]:
    """Relit's modules that are imported anywhere in the file, inside functions too, as tuples of names below the package."""
    out = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out |= {tuple(a.name.split(".")[1:]) for a in node.names if a.name.split(".")[0] == "relit"}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the direction"
            names = (node.module or "").split(".")
            if names[0] == "relit":
                package = SOURCE.joinpath(*names[1:]).is_dir()
                out |= {(*names[1:], a.name) if package else tuple(names[1:]) for a in node.names}
    return {n for n in out if n and n != ("__version__",)}


def wrong(path: Path, text: str | None = None) -> list[str]:
    """What the file imports against the direction."""
    part, here = part_of(path), path.relative_to(SOURCE).as_posix()
    found = []
    for names in imported(ast.parse(path.read_text() if text is None else text)):
        top = names[0]
        assert top in LEVEL, f"{here} imports relit.{top}, which stands in no row"
        renders_truth = here.startswith("capture/synthetic")
        allowed = LEVEL[top] <= LEVEL[part] or (renders_truth and top in GROUND_TRUTH)
        if part in BUILT_UPON and top == "fit":
            allowed = False
        synthetic = len(names) > 1 and names[0] == "capture" and names[1].startswith("synthetic")
        if synthetic and part not in USERS_OF_SYNTHETIC and not renders_truth:
            allowed = False
        if not allowed:
            found.append(f"{here} imports relit.{'.'.join(names)}")
    return found


@pytest.mark.parametrize("path", modules(), ids=lambda p: p.relative_to(SOURCE).as_posix())
def test_direction(path):
    assert part_of(path) in LEVEL, "a new module must be given its row"
    assert wrong(path) == []


@pytest.mark.parametrize(
    "path, text",
    [
        ("asset/gltf.py", "from relit.fit.loop import Adam"),
        ("evaluate/x.py", "def f():\n    import relit.fit"),
        ("scene.py", "from relit import capture"),
        ("geometry/sdf.py", "from relit.rendering import march"),
        ("capture/idr.py", "from relit.asset.gltf import read_asset_file"),
        ("fit/x.py", "from relit.capture.synthetic import look_at"),
        ("reconstruct.py", "from relit.capture import synthetic"),
        ("evaluate/x.py", "from relit.capture.synthetic_flash import synthesize_flash"),
    ],
)
def test_the_test_sees_a_wrong_import(path, text):
    assert wrong(SOURCE / path, text)


def test_parameter_names_of_mitsuba_stay_in_one_file():
    names = re.compile(r"vertex_positions|vertex_texcoords|\.to_world|base_color\.data|envmap\.data|emitter\.data|bsdf\.base_color")
    users = []
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n" not in node.value and names.search(node.value):
                users.append(path.relative_to(SOURCE).as_posix())
    assert set(users) <= {"rendering/mitsuba_scene.py"}


def test_nothing_is_pickled():
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert isinstance(node.value, ast.Constant) and node.value.value is False, path
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [a.name for a in node.names] + [getattr(node, "module", None)]
                assert not {"pickle", "dill", "joblib", "torch"} & set(names), path


def test_python_versions_are_declared():
    project = parse_toml((SOURCE.parents[1] / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == ">=3.10,<3.14"
