"""Weights of the segmenter: where they are looked for, and how they are fetched when asked for.

Nothing is fetched unless `relit weights segmenter` is called. The licence is shown first, the sum is
checked, and a file of the user's is taken in the place of a download with `--from`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

from relit.errors import EXIT_ENVIRONMENT, EXIT_USAGE, UserError
from relit.files import cache_folder

VARIABLE = "RELIT_SEGMENTER"  # of the environment: an ONNX file
COMMAND = "relit weights segmenter"
REMBG = Path.home() / ".u2net"  # where rembg keeps its weights
REMBG_NAMES = ("isnet-general-use", "u2net", "u2netp")  # the better ones first
CHUNK = 1 << 20  # bytes that are read at a time
PATIENCE = 30.0  # seconds without an answer after which a download is given up


@dataclass(frozen=True)
class Weights:
    """A file that can be fetched. sha256: of the file, in hexadecimal digits. size: bytes."""

    name: str
    url: str
    sha256: str
    size: int
    licence: str


SEGMENTER = Weights(
    "isnet-general-use.onnx",
    "https://github.com/danielgatis/rembg/releases/download/v0.0.0/isnet-general-use.onnx",
    "60920e99c45464f2ba57bee2ad08c919a52bbf852739e96947fbb4358c0d964a",
    178_648_008,
    "IS-Net, general use (Qin et al. 2022, https://github.com/xuebinqin/DIS): Apache-2.0; the file is "
    "the ONNX export of rembg (MIT). Trained on DIS5K, whose terms of use are its authors'.",
)


def kept_weights(weights: Weights = SEGMENTER) -> Path:
    """Where a fetched file is kept."""
    return cache_folder(None) / "weights" / weights.name


def find_segmenter(name: str = "") -> Path | None:
    """The ONNX file of the segmenter, None where none is at hand. name: a file, or a name in rembg's
    folder; where empty, RELIT_SEGMENTER, what `relit weights segmenter` has kept, and rembg's folder
    are looked at. Raises UserError where a file that was named is not there."""
    named = name or os.environ.get(VARIABLE, "")
    if named:
        places = [Path(named).expanduser(), REMBG / f"{named}.onnx"]
        found = next((p for p in places if p.is_file()), None)
        if found is None:
            raise UserError(f"no network at: {named}", fix=f"give an ONNX file, or call {COMMAND}")
        return found
    usual = [kept_weights(), *(REMBG / f"{n}.onnx" for n in REMBG_NAMES)]
    return next((p for p in usual if p.is_file()), None)


def sum_of(file: Path) -> str:
    """SHA-256 of a file."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(CHUNK):
            digest.update(block)
    return digest.hexdigest()


def keep_weights(
    source: Path | None,
    weights: Weights = SEGMENTER,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Copy `source`, or download the file where it is None, to `kept_weights`. progress: called with
    bytes done and in all. Raises UserError where the file cannot be had or is another one."""
    out = kept_weights(weights)
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        if source is not None:
            if not source.is_file():
                raise UserError(f"no file: {source}", code=EXIT_USAGE)
            shutil.copyfile(source, part)
        else:
            download(weights, part, progress)
        if (found := sum_of(part)) != weights.sha256:
            raise UserError(
                "the file is not the one that was asked for",
                f"its SHA-256 is {found[:16]}..., expected {weights.sha256[:16]}...",
                "use another network with --masks segment:FILE.onnx or RELIT_SEGMENTER",
            )
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return out


def download(weights: Weights, part: Path, progress: Callable[[int, int], None]) -> None:
    """The file at `weights.url` into `part`. Raises UserError without a network."""
    try:
        with urlopen(weights.url, timeout=PATIENCE) as stream, part.open("wb") as file:
            done = 0
            while block := stream.read(CHUNK):
                file.write(block)
                progress(done := done + len(block), weights.size)
    except (URLError, OSError) as error:
        raise UserError(
            "the weights could not be fetched",
            str(error)[:200],
            f"fetch {weights.url} elsewhere and call {COMMAND} --from FILE",
            code=EXIT_ENVIRONMENT,
        ) from None
