"""Files that survive a crash: atomic writes, arrays without pickle, TOML, content digests, and what
a full disk says."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import tomli_w

from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.log import readable_bytes

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def cache_folder(cache: str | Path | None = None) -> Path:
    """Where rendered captures and generated objects are kept: `cache`, else RELIT_CACHE, else ~/.cache/relit."""
    return Path(cache or os.environ.get("RELIT_CACHE") or Path.home() / ".cache" / "relit")


def write_text(path: Path, text: str) -> None:
    """Write a text file such that it is either the old or the new one, whenever the process
    dies."""
    _atomic(path, lambda file: file.write(text.encode("utf-8")))


def save_arrays(path: Path, arrays: dict) -> None:
    """Write {name: array} as an .npz that `np.load(allow_pickle=False)` reads, atomically,
    uncompressed."""
    ready = {key: np.asarray(value) for key, value in arrays.items()}
    objects = [key for key, value in ready.items() if value.dtype.hasobject]
    if objects:
        raise TypeError(f"not an array of numbers or text: {', '.join(objects)}")

    def write(file) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for key, value in ready.items():
                with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, value, allow_pickle=False)

    _atomic(path, write)


# what np.load raises for damaged files, its header being parsed as Python
NO_ARRAYS = (
    OSError,
    ValueError,
    TypeError,
    EOFError,
    LookupError,
    SyntaxError,
    MemoryError,
    NotImplementedError,
)
NO_ARRAYS = (*NO_ARRAYS, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error)


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an .npz whole (its checksums are verified on the way). Never unpickles."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def _atomic(path: Path, write: Callable) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def digests(root: Path, names: Iterable[str]) -> dict[str, str]:
    """{name: 'size:hash'} of files under `root` (BLAKE2b of the content): a replaced photo is
    noticed, a moved folder is not."""
    out = {}
    for name in names:
        path = root / name
        with path.open("rb") as file:
            state = hashlib.blake2b(digest_size=12)
            while block := file.read(1 << 20):
                state.update(block)
        out[name] = f"{path.stat().st_size}:{state.hexdigest()}"
    return out


def toml_text(config: dict) -> str:
    """TOML of a dictionary: strings, numbers, booleans, lists of those, and tables. None is left
    out. Raises TypeError for other values."""
    return tomli_w.dumps(_plain(config))


def parse_toml(text: str) -> dict:
    """TOML -> a dictionary. Raises ValueError."""
    return tomllib.loads(text)


def _plain(value):
    """The value with paths as text, NumPy numbers as Python's, and without None in tables."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


def read_json(path: Path) -> dict | None:
    """A small JSON file, or None where there is none or it cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


@contextlib.contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Turn 'no space left', 'quota exceeded', 'read-only' and 'permission denied' under `folder`
    into a UserError (exit code 5)."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, folder) or error from None


def disk_error(error: OSError, folder: Path) -> UserError | None:
    """The UserError for an OSError of a full, small or closed disk, or None if it is another
    one."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        free = shutil.disk_usage(_existing(folder)).free
        return UserError(
            f"the disk is full: {error.strerror}, {readable_bytes(free)} free",
            "the run folder takes checkpoints, textures and pictures, a few hundred MB",
            f"free some space and give the same command again (it resumes), or use another -o: {folder}",
            code=EXIT_ENVIRONMENT,
        )
    inside = error.filename is not None and Path(
        os.fsdecode(error.filename)
    ).absolute().is_relative_to(_existing(folder))
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM) and inside:
        why = "the output folder belongs to someone else or the disk is read-only"
        return UserError(
            f"cannot write: {error.strerror}",
            why,
            f"choose another -o: {error.filename}",
            code=EXIT_ENVIRONMENT,
        )
    return None


def _existing(path: Path) -> Path:
    path = Path(path).absolute()
    while not path.exists():
        path = path.parent
    return path
