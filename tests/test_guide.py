"""The documents: examples run, commands parse, links have targets, named code exists, lines are
short."""

from __future__ import annotations

import ast
import json
import re
import runpy
import shlex
import sys
import textwrap
import types
from pathlib import Path

import numpy as np
import pytest

from relit.asset.asset import load_asset
from relit.capture.open import READERS, open_capture
from relit.cli.verbs import VERBS, parser_for
from relit.errors import UserError
from relit.evaluate.collection import DEFINITIONS as COLLECTION
from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.duplicates import DUPLICATES_DEFINITIONS as DUPLICATES
from relit.evaluate.flash import FLASH_DEFINITIONS as FLASH
from relit.evaluate.protocols import orb, pir, samurai, sfd
from relit.evaluate.registration import DEFINITIONS as REGISTRATION
from relit.files import parse_toml
from relit.viewer.page import PAGE
from support import camera_ring
from support.striped_ball import write_capture

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCE = ROOT / "src" / "relit"
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TINY = {"levels": (16,), "level_steps": (12,), "rays": 128, "faces": 300, "texture": 16, "light": 4}
TINY |= {"surface_steps": 4, "points": 32, "directions": 4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("guide")
    write_capture(out / "photos")
    return out


def example(monkeypatch, capsys, number, *argv) -> str:
    path = next(p for p in EXAMPLES if p.name.startswith(f"{number:02d}_"))
    monkeypatch.setattr(sys, "argv", [str(path), *map(str, argv)])
    runpy.run_path(str(path), run_name="__main__")
    return capsys.readouterr().out


@pytest.mark.slow
def test_examples_in_order(monkeypatch, capsys, folder, report_sizes):
    import relit.fit.multiview.recipe as multiview

    monkeypatch.setitem(multiview.PRESETS, "draft", TINY)
    run = folder / "run"
    assert "6 photos, read as transforms" in example(monkeypatch, capsys, 1, folder / "photos")
    said = example(monkeypatch, capsys, 2, folder / "photos", run)
    assert "triangles" in said and (run / "asset/object.glb").is_file()
    assert len(example(monkeypatch, capsys, 3, run, folder / "out").splitlines()) == 3
    if PAGE.is_file():
        assert "fetches nothing" in example(monkeypatch, capsys, 4, run, folder / "page.html")
    example(monkeypatch, capsys, 5, run, folder / "glossy.glb")
    from relit.asset.gltf import read_asset_file

    assert (
        read_asset_file(folder / "glossy.glb")[1].roughness.max() <= 0.26
        and np.isfinite(load_asset(run).mesh.vertices).all()
    )


def test_examples_are_numbered_and_have_a_usage_line():
    assert [int(p.name[:2]) for p in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    assert all(f"python examples/{p.name} " in p.read_text() for p in EXAMPLES)


def commands():
    for page in PAGES:
        for block in re.findall(r"```[a-z]*\n(.*?)```", page.read_text(encoding="utf-8"), re.S):
            for line in block.splitlines():
                line = re.sub(r"^(\$ |\.venv/bin/)", "", line.strip()).split(" #")[0]
                if line.startswith("relit ") and "VERB" not in line:
                    yield pytest.param(line, id=f"{page.name}: {line}")


@pytest.mark.parametrize("line", commands())
def test_every_command_of_the_guide_parses(line):
    verb, *words = shlex.split(line.replace("[", "").replace("]", "").replace("...", ""))[1:]
    assert verb in VERBS, line
    try:
        assert parser_for(verb, words).parse(words) is not None
    except UserError as error:
        pytest.fail(f"{line}: {error}")


def test_reader_of_contributing(monkeypatch, tmp_path):
    """The reader and its test in CONTRIBUTING.md work as printed."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    reader, check = re.findall(r"^ *```python\n(.*?)^ *```", text, re.S | re.M)
    module = types.ModuleType("my_format")
    exec(reader, module.__dict__)
    general = READERS["photos"]  # recognises every folder of photos, so it comes last
    monkeypatch.delitem(READERS, "photos")
    monkeypatch.setitem(READERS, "my_format", module)
    monkeypatch.setitem(READERS, "photos", general)
    names = {"np": np, "json": json, "open_capture": open_capture, "camera_ring": camera_ring}
    exec(textwrap.dedent(check), names)
    names["test_my_format"](tmp_path, camera_ring.ring())


def test_links_have_targets():
    lost = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if "://" not in target and not (page.parent / target).exists():
                lost.append(f"{page.name}: {target}")
    assert not lost


def code_exists(name: str) -> bool:
    """Whether `tests/x.py`, `fit/x.py`, `fit/x.f` or `fit/x.Class.f` exists."""
    if name.split("/")[0] in ("tests", "tools") or (SOURCE / name).exists():
        return (ROOT / name).exists() or (SOURCE / name).exists()
    module, *attributes = name.split(".")
    if not (SOURCE / f"{module}.py").is_file():
        return False
    body = ast.parse((SOURCE / f"{module}.py").read_text()).body
    for attribute in attributes:
        body = next(
            (
                n.body
                for n in body
                if isinstance(n, (ast.FunctionDef, ast.ClassDef)) and n.name == attribute
            ),
            None,
        )
        if body is None:
            return False
    return True


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "README.md"], ids=lambda p: p.name)
def test_code_named_in_a_document_exists(page):
    parts = {p.name for p in SOURCE.iterdir() if p.is_dir()} | {"tests", "tools"}
    text = page.read_text(encoding="utf-8")
    names = [n for n in re.findall(r"`([\w./]+)`", text) if "/" in n and n.split("/")[0] in parts]
    least = {"equations.md": 90, "architecture.md": 60, "method.md": 20, "duplicates.md": 20}
    assert len(names) >= least.get(page.name, 0)
    files_of_assets = (".json", ".glb")
    assert [n for n in names if not n.endswith(files_of_assets) and not code_exists(n)] == []


def test_lines_of_documents_are_at_most_100_columns():
    pages = {*PAGES, *ROOT.glob("*.md"), *(ROOT / "docs/research").glob("*.md")}
    wide = [
        f"{page.relative_to(ROOT)}:{number}"
        for page in sorted(pages)
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > 100
    ]
    assert wide == []


def test_modules_of_the_architecture_are_all_packages():
    """The diagram lists every package of tests/test_imports.py, lower rows below."""
    tree = ast.parse((ROOT / "tests/test_imports.py").read_text(encoding="utf-8"))
    table = next(
        n.value for n in tree.body if isinstance(n, ast.Assign) and n.targets[0].id == "ROWS"
    )
    layers = ast.literal_eval(table)
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    diagram = re.search(r"```\n(.*?)```", text, re.S).group(1)
    rows = [set(line.split()) for line in diagram.splitlines()]
    for row in layers:
        for name in set(row) - {"__init__", "__main__"}:
            assert any(name in words for words in rows), name
    place = {w: i for i, words in enumerate(rows) for w in words}
    order = [min(place[n] for n in row if n in place) for row in layers]
    assert order == sorted(order, reverse=True)


def listed_flags(verb, kind) -> set[str]:
    """The flags that docs/flags.md lists for a verb, and for one of its kinds."""
    text = (ROOT / "docs/flags.md").read_text(encoding="utf-8")
    sections = dict(part.split("\n", 1) for part in re.split(r"^##+ relit ", text, flags=re.M)[1:])
    found = sections[verb] + (
        sections.get(f"{kind}: own flags" if " " in kind else kind, "") if kind else ""
    )
    return {
        o
        for line in found.splitlines()
        if line.startswith("| `-")
        for o in re.findall(r"`(--?[a-z][a-z-]*)`", line.split(" | ")[0])
    }


@pytest.mark.parametrize(
    "verb, kind", [(v, k) for v, spec in VERBS.items() for k in (list(spec.kinds) or [None])]
)
def test_flags_page_lists_all_flags(verb, kind):
    known = {
        o
        for a in parser_for(verb, [kind] if kind else [])._actions
        if a.dest != "help"
        for o in a.option_strings
    }
    assert listed_flags(verb, kind and f"{verb} {kind}") == known


def test_definitions_page_defines_all_figures():
    defined = set(
        re.findall(r"^\* `([a-z_0-9]+)`", (ROOT / "docs/definitions.md").read_text(), re.M)
    )
    assert (
        defined
        == {
            name
            for some in (
                *(DEFINITIONS, FLASH, COLLECTION, DUPLICATES, REGISTRATION),
                *(each.DEFINITIONS for each in (sfd, pir, samurai, orb)),
            )
            for name in some
        }
        and len(defined) > 10
    )


def test_every_dependency_is_listed_with_its_licence():
    text = (ROOT / "docs/licences.md").read_text().lower().replace("_", "-")
    project = parse_toml((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *[n for names in project["optional-dependencies"].values() for n in names],
    ]
    names = [re.split(r"[\s<>=!~;\[]", w, maxsplit=1)[0].lower() for w in wanted]
    for folder in ("viewer", "tools/validator"):
        package = json.loads((ROOT / folder / "package.json").read_text())
        names += [*package.get("dependencies", {}), *package.get("devDependencies", {})]
    assert [n for n in names if f"| {n}" not in text and n != "tomli"] == []
    assert "see its page" not in text


def test_what_is_published_carries_the_page_and_its_notices():
    assert (
        "viewer/static" in (ROOT / "pyproject.toml").read_text()
        and "graft src/relit/viewer/static" in (ROOT / "MANIFEST.in").read_text()
    )
    if not PAGE.is_file():
        pytest.skip("the page is not built (make viewer)")
    text = PAGE.read_text(encoding="utf-8")
    assert (
        "three.js authors" in text[:6000]
        and "Garrett Johnson" in text[:6000]
        and "Permission is hereby granted" in text[:6000]
    )
