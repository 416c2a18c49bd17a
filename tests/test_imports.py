"""The direction of imports, read from the sources: a module imports only what stands below it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from relit.files import parse_toml

SOURCE = Path(__file__).resolve().parents[1] / "src" / "relit"
# Packages from the ground up. A module may import modules of lower rows, and of its own package.
ROWS = [
    ["errors", "conventions", "__init__"],
    ["images", "log", "files", "records", "run", "settings", "device"],
    ["scene", "recipe"],
    ["geometry", "materials", "lighting", "masks"],
    ["capture/readers", "capture"],
    ["cameras"],
    ["reference"],
    ["rendering"],
    ["fit/passes"],
    ["fit/shape"],
    ["fit/registration"],
    ["fit/multiview", "fit/flash", "fit/duplicates", "fit/collection"],
    ["asset"],
    ["relight", "edit", "synthesize", "evaluate"],
    ["report", "viewer"],
    ["job", "preflight", "reconstruction", "api", "demo", "benchmark", "doctor"],
    ["cli", "__main__"],
]
LEVEL = {name: i for i, row in enumerate(ROWS) for name in row}
# These read asset folders only: never import `fit`.
WITHOUT_FIT = (
    "asset",
    "relight",
    "edit",
    "evaluate",
    "report",
    "viewer",
    "synthesize",
    "preflight",
)
# The recipes of the captures do not know each other.
RECIPES = ("fit/multiview", "fit/flash", "fit/duplicates", "fit/collection")
SPLIT = ("fit", "capture/readers")  # packages whose folders have rows of their own


def modules():
    return sorted(SOURCE.rglob("*.py"))


def part_of(names: tuple[str, ...]) -> str:
    """The row's name of a module: ('capture', 'readers', 'idr') -> 'capture/readers', ('run',) ->
    'run'."""
    two = "/".join(names[:2])
    return two if two in LEVEL else names[0]


def names_of(path: Path) -> tuple[str, ...]:
    return path.relative_to(SOURCE).with_suffix("").parts


def imported(tree: ast.AST) -> set[tuple[str, ...]]:
    """Relit's modules that are imported anywhere in the file, inside functions too, as tuples of
    names below the package."""
    out = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out |= {
                tuple(a.name.split(".")[1:]) for a in node.names if a.name.split(".")[0] == "relit"
            }
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the direction"
            names = (node.module or "").split(".")
            if names[0] == "relit":
                package = SOURCE.joinpath(*names[1:]).is_dir()
                out |= {(*names[1:], a.name) if package else tuple(names[1:]) for a in node.names}
    return {n for n in out if n and n != ("__version__",)}


def wrong(path: Path, text: str | None = None) -> list[str]:
    """What the file imports against the direction."""
    here = path.relative_to(SOURCE).as_posix()
    part = part_of(names_of(path))
    if part == "fit":  # the package's own __init__
        return []
    found = []
    for names in imported(ast.parse(path.read_text() if text is None else text)):
        target = part_of(names)
        if target == "fit" or target not in LEVEL:
            found.append(f"{here} imports relit.{'.'.join(names)}, which stands in no row")
            continue
        allowed = LEVEL[target] <= LEVEL[part]
        if part in WITHOUT_FIT and target.startswith("fit/"):
            allowed = False
        if part in RECIPES and target in RECIPES and target != part:
            allowed = False
        if not allowed:
            found.append(f"{here} imports relit.{'.'.join(names)}")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", modules(), ids=lambda p: p.relative_to(SOURCE).as_posix())
def test_direction(path):
    part = part_of(names_of(path))
    assert part in LEVEL or part == "fit", "a new package must be given its row"
    assert wrong(path) == []


@pytest.mark.parametrize(
    "path, text",
    [
        ("asset/gltf.py", "from relit.fit.passes.optimiser import Adam"),
        ("evaluate/x.py", "def f():\n    import relit.fit"),
        ("scene.py", "from relit.capture import open"),
        ("geometry/sdf.py", "from relit.rendering import march"),
        ("capture/readers/idr.py", "from relit.asset.gltf import read_asset_file"),
        ("fit/passes/x.py", "from relit.fit.shape import outlines"),
        ("fit/flash/x.py", "from relit.fit.multiview import recipe"),
        ("fit/multiview/x.py", "from relit.synthesize.multiview import look_at"),
        ("reconstruction.py", "from relit.cli import main"),
        ("reference/x.py", "from relit.rendering.march import march"),
    ],
)
def test_the_test_sees_a_wrong_import(path, text):
    assert wrong(SOURCE / path, text)


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of nodes that reach each other (Tarjan's strongly connected components of more than
    one node)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    out: list[list[str]] = []

    def visit(v: str) -> None:
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in graph[v]:
            if w not in index:
                visit(w)
            if w in stack:
                low[v] = min(low[v], low[w])
        if low[v] == index[v]:
            at = stack.index(v)
            if len(stack) - at > 1:
                out.append(sorted(stack[at:]))
            del stack[at:]

    for v in graph:
        if v not in index:
            visit(v)
    return out


def graph_of_modules() -> dict[str, set[str]]:
    known = {".".join(names_of(path)).removesuffix(".__init__"): path for path in modules()}
    found = {
        name: {".".join(n) for n in imported(ast.parse(path.read_text()))}
        for name, path in known.items()
    }
    return {
        name: {n for n in targets if n in known and n != name} for name, targets in found.items()
    }


def test_no_cycle_among_modules():
    assert cycles(graph_of_modules()) == []


def test_no_cycle_among_folders():
    graph = graph_of_modules()
    packages = {
        ".".join(names_of(path)).removesuffix(".__init__")
        for path in modules()
        if path.name == "__init__.py"
    }
    folder = {name: name if name in packages else name.rpartition(".")[0] for name in graph}
    folders: dict[str, set[str]] = {f: set() for f in folder.values()}
    for name, targets in graph.items():
        for target in targets:
            a, b = folder[name], folder[target]
            if not (a == b or a.startswith(b + ".") or b.startswith(a + ".") or "" in (a, b)):
                folders[a].add(b)
    assert cycles(folders) == []


def test_the_search_for_cycles_finds_one():
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]


def test_parameter_names_of_mitsuba_stay_in_one_file():
    names = re.compile(
        r"vertex_positions|vertex_texcoords|\.to_world|base_color\.data|envmap\.data|emitter\.data|bsdf\.base_color"
    )
    users = []
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and "\n" not in node.value
                and names.search(node.value)
            ):
                users.append(path.relative_to(SOURCE).as_posix())
    assert set(users) <= {"reference/mitsuba_scene.py"}


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
