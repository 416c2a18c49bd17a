"""`NameIndex`: from a name in a camera, mask or annotation file to the file that it means.

Names are written on one machine and files lie on another: Unicode comes composed or decomposed
(macOS), letter case differs (Windows), a tool wrote PNG for JPEG, or paths are absolute ones of the
machine that found the cameras. The rules are tried in this order, and each use of another rule than
the first is noted:

1. the name as it is, relative to each base folder;
2. equal after Unicode normalisation (NFC), then with folded letter case;
3. equal without the extension of a picture, where one file only is;
4. the same, of ever shorter ends of the path, then of the file name anywhere below the root.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

from relit.errors import UserError
from relit.images import EXTENSIONS

MOST_FILES = 200_000  # of a folder; more are not indexed
RULES = {
    "unicode": "with another Unicode form of the name",
    "case": "with another letter case",
    "extension": "with another extension",
    "path": "by the end of their path",
    "upload": "without what an upload adds to the name",
}


def is_hidden(path: Path) -> bool:
    """Hidden files, and the folder in which a Mac's zip keeps attributes of files."""
    return path.name.startswith(".") or path.name == "__MACOSX"


def folded(name: str) -> str:
    """A name without the differences that Unicode form and letter case make."""
    return unicodedata.normalize("NFC", name).casefold()


def stem_of(name: str) -> str:
    """A name without its extension, where that is one of a picture: 'r_0.5' stays."""
    stem, dot, end = name.rpartition(".")
    return stem if dot and "." + end.lower() in EXTENSIONS else name


def stem_key(name: str) -> str:
    """What names of one photo share: the file name without folders, extension, Unicode form and
    letter case."""
    parts = plain_parts(name)
    return folded(stem_of(parts[-1])) if parts else ""


def plain_parts(name: str) -> tuple[str, ...]:
    """The parts of a path of any system without drive, root, '.' and what leads upwards."""
    name = re.sub(r"^(file:/+|[A-Za-z]:)", "", name.replace("\\", "/"))
    return tuple(p for p in name.split("/") if p not in ("", ".", ".."))


def files_below(root: Path) -> list[Path]:
    """All files below a folder but hidden ones, sorted; of links to folders none is followed."""
    out: list[Path] = []
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(d for d in folders if not is_hidden(Path(d)))
        out += [Path(folder, f) for f in sorted(files) if not is_hidden(Path(f))]
        if len(out) > MOST_FILES:
            break
    return out


class NameIndex:
    """The files of one kind below `root`, found by name. extensions: lower case, with the dot.
    Uses of other rules than the exact name are counted, for `notes`."""

    def __init__(self, root: Path, extensions: Iterable[str] = EXTENSIONS):
        self.root = root
        self.extensions = frozenset(extensions)
        self.used: list[tuple[str, str, Path]] = []  # rule, name as written, file

    @cached_property
    def _keys(self) -> dict[str, dict[str, list[Path]]]:
        """rule -> key of the relative path -> files."""
        out: dict[str, dict[str, list[Path]]] = {r: {} for r in ("unicode", "case", "extension")}
        for file in files_below(self.root):
            if file.suffix.lower() in self.extensions:
                relative = file.relative_to(self.root).as_posix()
                for rule in out:
                    out[rule].setdefault(_key(rule, relative), []).append(file)
        return out

    @cached_property
    def _ends(self) -> dict[str, dict[str, list[Path]]]:
        """rule -> key of the file name -> files anywhere below the root."""
        out: dict[str, dict[str, list[Path]]] = {r: {} for r in ("unicode", "case", "extension")}
        for files in self._keys["unicode"].values():
            for file in files:
                for rule in out:
                    out[rule].setdefault(_key(rule, file.name), []).append(file)
        return out

    def find(self, name: str, bases: Iterable[Path] = (), *, anywhere: bool = True) -> Path | None:
        """The file that `name` means, relative to one of the folders `bases` (the root where none
        is given). anywhere: a name without folders may lie in another folder, where one file only
        has it. None where there is none, or no rule gives one file only. Of a path whose folder is
        there no other folder is searched: a photo that is missing is not another one's twin."""
        bases = tuple(bases) or (self.root,)
        exact = self._exact(name, bases)
        if exact is not None:
            return exact
        parts = plain_parts(name)
        if not parts:
            return None
        moved = self._is_moved(name, parts, bases, anywhere)
        for skipped in range(len(parts) if moved else 1):
            end = "/".join(parts[skipped:])
            for base in bases:
                cut = skipped or end != name.replace("\\", "/").removeprefix("./")
                if cut and (file := self._exact(end, (base,))) is not None:
                    return self._noted("path", name, file)
                found = self._by_key(self._keys, _relative(base, self.root, end))
                if found is not None:
                    rule = "path" if cut else found[0]
                    return self._noted(rule, name, found[1])
        found = self._by_key(self._ends, parts[-1]) if moved else None
        if found is not None:
            return self._noted("path", name, found[1])
        renamed = before_upload(name)
        file = self.find(renamed, bases, anywhere=anywhere) if renamed != name else None
        if self.used and self.used[-1][1] == renamed:
            self.used.pop()  # noted below, under the name as written
        return None if file is None else self._noted("upload", name, file)

    def _is_moved(
        self, name: str, parts: tuple[str, ...], bases: tuple[Path, ...], anywhere: bool
    ) -> bool:
        """Whether the folders of the name are none of this capture's."""
        name = name.replace("\\", "/")
        if name.startswith("/") or re.match(r"(file:|[A-Za-z]:)", name) or ".." in name.split("/"):
            return True
        if len(parts) == 1:
            return anywhere
        return not any(base.joinpath(*parts[:-1]).is_dir() for base in bases)

    def _exact(self, name: str, bases: tuple[Path, ...]) -> Path | None:
        root = Path(os.path.normpath(self.root))
        for base in bases:
            file = Path(os.path.normpath(base / name.replace("\\", "/")))
            try:
                inside = "\0" not in name and file.is_relative_to(root)
                if inside and file.suffix.lower() in self.extensions and file.is_file():
                    return file
            except OSError:  # a name that the file system cannot hold
                return None
        return None

    def _by_key(self, table: dict[str, dict[str, list[Path]]], name: str):
        """-> (rule, file) by the first rule that gives one file only."""
        for rule in ("unicode", "case", "extension"):
            files = table[rule].get(_key(rule, name), [])
            if not files and rule == "extension":  # masks/0001.jpg.png of 0001.jpg
                files = table[rule].get(folded(name), [])
            if len(files) == 1:
                return rule, files[0]
            if files:
                return None
        return None

    def _noted(self, rule: str, name: str, file: Path) -> Path:
        self.used.append((rule, name, file))
        return file

    def notes(self, what: str) -> list[str]:
        """One note for each rule that was used. what: the plural of what is named."""
        out = []
        for rule, count in Counter(rule for rule, _, _ in self.used).items():
            _, name, file = next(u for u in self.used if u[0] == rule)
            where = file.relative_to(self.root).as_posix()
            out.append(
                f"{count} {what} were found {RULES[rule]}: '{name[-120:]}' is taken for {where}"
            )
        return out


def _key(rule: str, name: str) -> str:
    if rule == "unicode":
        return unicodedata.normalize("NFC", name)
    return folded(name) if rule == "case" else folded(stem_of(name))


def before_upload(name: str) -> str:
    """A name without %20 for a space and without the eight digits that Label Studio puts before
    it."""
    folder, slash, last = unquote(name).replace("\\", "/").rpartition("/")
    return folder + slash + re.sub(r"^[0-9a-f]{8}-(?=.)", "", last)


def _relative(base: Path, root: Path, name: str) -> str:
    inside = base.is_relative_to(root)
    return (base.relative_to(root) / name).as_posix() if inside else name


def path_inside(root: Path, name: str, source: Path) -> Path:
    """root / name, refused when it leaves `root`. `source` is the file that names it."""
    name = name.replace("\\", "/")
    target = Path(os.path.normpath(root / name))
    if "\0" in name or not target.is_relative_to(Path(os.path.normpath(root))):
        raise UserError(
            f"a camera file names an image outside the capture: '{name[:200]}'",
            "paths must stay inside the folder that is opened, so that a capture can be moved and "
            "shared, and no file of that name lies in it",
            f"put the images under {root}, or put the camera file into the folder above them and "
            f"make the paths relative: {source}",
        )
    return target
