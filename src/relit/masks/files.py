"""Mask files beside the photos, and what can be wrong with them."""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from pathlib import Path

import numpy as np

from relit.errors import UserError
from relit.images import EXTENSIONS, read_data
from relit.images.decode import CODED, pil

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr")
FOLDERS = ("masks", "mask", "segmentations", "silhouettes")
NAMED_MASK = re.compile(
    r"(?<![a-z])(object|fg|sam)?(mask|silhouette|matte|segmentation)s?(?![a-z])"
)
AFFIX = re.compile(
    r"^(object_|fg_)?(mask|matte|silhouette)[_.-]+|[_.-]+(object_|fg_)?(mask|matte|silhouette|seg)s?$",
    re.IGNORECASE,
)  # of a mask's stem, beside its photo's name
PHOTO_FOLDERS = ("images", "image", "rgb", "input", "photos")  # masks/ may lie beside them
LOSSY = (".jpg", ".jpeg", ".webp")  # black is not exactly 0 there
BORDER = 0.9  # an inverted mask covers at least this share of the photo's border


def find_mask(photo: Path, root: Path, index: dict[str, Path]) -> Path | None:
    """The mask of a photo: STEM_mask.png, STEM.mask.png or NAME.jpg.mask.png beside it, else a file
    of the same name, stem or number in a mask folder. Unicode form and letter case do not
    matter."""
    beside = _masks_beside(photo.parent, photo.parent.stat().st_mtime_ns)
    bare = photo.stem.removesuffix("_rgb")  # Synthetic4Relight: 000_rgb.exr, 000_mask.png
    for name in (photo.name, photo.stem, bare):
        if _folded(name) in beside:
            return beside[_folded(name)]
    relative = photo.relative_to(root).as_posix() if photo.is_relative_to(root) else photo.name
    without_top = relative.split("/", 1)[-1]
    exact = [
        k for r in (relative, without_top) for k in (r + ".png", r, str(Path(r).with_suffix("")))
    ]  # train/000 before 000
    for key in (*exact, photo.name, photo.stem):
        if _folded(key) in index:
            return index[_folded(key)]
    number = _number(photo.stem)
    return index.get(f"#{number}") if number is not None else None


@lru_cache(maxsize=16)
def _masks_beside(folder: Path, changed: int) -> dict[str, Path]:
    """Files of a folder that are masks by their names: name or stem of the photo -> mask. changed:
    the folder's time of change, so that a new file is seen."""
    out: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        stem = AFFIX.sub("", file.stem)
        hidden = file.name.startswith(".") or file.suffix.lower() not in MASK_SUFFIXES
        if stem != file.stem and not hidden:
            out.setdefault(_folded(stem), file)
    return out


def index_masks(root: Path, places: tuple[Path, ...] = ()) -> tuple[Path | None, dict[str, Path]]:
    """The mask folder of a capture (or None) and its files by relative name, name, stem (without
    what says that it is a mask) and number. places: further folders in which a mask folder may
    lie."""
    above = (root.parent,) if root.name.lower() in PHOTO_FOLDERS else ()
    for base in dict.fromkeys([root, *above, *places]):
        for folder in mask_folders(base):
            files = sorted(
                f
                for f in folder.rglob("*")
                if f.suffix.lower() in EXTENSIONS and not f.name.startswith(".")
            )
            if not files:
                continue
            index: dict[str, Path] = {}
            for f in files:
                relative = f.relative_to(folder)
                number = _number(f.stem)
                for key in (
                    relative.as_posix(),
                    relative.with_suffix("").as_posix(),
                    f.name,
                    f.stem,
                    *([f"#{number}"] if number is not None else []),
                ):
                    index.setdefault(_folded(key), f)
            for f in files:
                index.setdefault(_folded(AFFIX.sub("", f.stem)), f)
            return folder, index
    return None, {}


def mask_folders(root: Path) -> list[Path]:
    """Sub-folders whose names say that they hold masks, in any letter case: FOLDERS in their order,
    then others such as object_mask/ or fg_masks/."""
    if not root.is_dir():
        return []
    inside = sorted(d for d in root.iterdir() if d.is_dir() and not d.name.startswith("."))
    rank = {name: k for k, name in enumerate(FOLDERS)}
    named = [d for d in inside if d.name.lower() in rank]
    others = [d for d in inside if d not in named and names_masks(d.name)]
    return [*sorted(named, key=lambda d: (rank[d.name.lower()], d.name)), *others]


def names_masks(folder: str) -> bool:
    """Whether the name of a folder says that it holds masks of the object. BOP's mask_visib holds
    those of instances, instant-ngp's dynamic masks those of what moves."""
    name = folder.lower()
    return NAMED_MASK.search(name) is not None and not re.search(r"visib|dynamic", name)


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _number(stem: str) -> int | None:
    """The number in names such as 000012, mask_12: DTU pairs image/000012.png with mask/012.png."""
    digits = re.findall(r"\d+", stem)
    return int(digits[0]) if len(digits) == 1 and len(digits[0]) < 18 else None


def read_mask(path: Path) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the alpha channel where it varies, else the mean of the colour
    channels; see `read_counted`."""
    return read_counted(path)[0]


def read_counted(path: Path) -> tuple[np.ndarray, bool]:
    """`read_mask`, and whether the file holds the numbers 0 and 1 in the place of black and white:
    1 is the object then."""
    data = np.clip(read_data(path), 0.0, 1.0)
    if data.ndim == 3 and data.shape[2] in (2, 4):
        alpha = data[..., -1]
        if alpha.min() < 0.5 < alpha.max():
            return alpha, False
        data = data[..., :-1]
    if data.ndim == 3 and _indexed(path):
        return _of_palette(data), False
    mask = data if data.ndim == 2 else data.mean(axis=-1)
    if path.suffix.lower() not in LOSSY and _is_counted(mask):
        return (mask > 0).astype(np.float32), True
    return mask, False


def _is_counted(mask: np.ndarray) -> bool:
    """Whether a decoded picture holds no codes but 0 and 1, of 255 or of 65535, as programs write
    that number objects."""
    top = float(mask.max(initial=0.0))
    return any(abs(top * codes - 1) < 1e-3 for codes in (255, 65535)) and bool(
        ((mask == 0) | (mask == top)).all()
    )


def _indexed(path: Path) -> bool:
    """Is it a picture with a palette whose first colour is black? DAVIS and VOC number their
    objects so."""
    if path.suffix.lower() not in CODED:
        return False
    with pil(path) as image:
        return image.mode == "P" and image.getpalette()[:3] == [0, 0, 0]


def _of_palette(rgb: np.ndarray) -> np.ndarray:
    """(H, W) of (H, W, 3): every colour but black is an object, dark red too; grey levels as they
    are, unless none is bright."""
    soft = rgb.max() > 0.5 and (rgb == rgb[..., :1]).all()
    return rgb[..., 0] if soft else rgb.any(axis=-1).astype(np.float32)  # pyright: ignore[reportReturnType]


def border_share(mask: np.ndarray) -> float:
    """Share of a (H, W) mask's border pixels that it covers."""
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return float((edge > 0.5).mean())


def looks_inverted(mask: np.ndarray) -> bool:
    """True when the mask covers the border all around and what it leaves out lies inside, away from
    the border."""
    if border_share(mask) < BORDER:
        return False
    outside = mask < 0.5
    share = float(outside.mean())
    if not 0.005 < share < 0.9:
        return False
    import cv2

    h, w = mask.shape
    _, _, stats, _ = cv2.connectedComponentsWithStats(outside.astype(np.uint8), connectivity=8)
    x, y, bw, bh, area = stats[1:].T
    away = (x > 0) & (y > 0) & (x + bw < w) & (y + bh < h)
    return bool(area[away].sum() > 0.8 * area.sum())


def _is_negative(mask: np.ndarray) -> bool:
    """True when the corners are white and the middle is black: an inverted mask whose object
    touches the border. Of an object that fills the picture the middle is white."""
    h, w = mask.shape
    a, b = max(1, h // 8), max(1, w // 8)
    corners = (mask[:a, :b], mask[:a, -b:], mask[-a:, :b], mask[-a:, -b:])
    middle = mask[h // 2 - a // 2 : h // 2 + a // 2 + 1, w // 2 - b // 2 : w // 2 + b // 2 + 1]
    white = sum(float((c > 0.5).mean()) > 0.8 for c in corners)
    return white >= 3 and float((middle > 0.5).mean()) < 0.2 and border_share(mask) > 0.5


def _most(turned: list[str], rest: dict[str, np.ndarray], inverted: list[str]) -> bool:
    """Whether the masks are inverted though the object touches the border in some: nearly all look
    so, and no mask looks right, with black corners and a white middle."""
    right = [n for n, m in rest.items() if n not in turned and _is_negative(1.0 - m)]
    return len(rest) >= 3 and len(turned) >= 0.8 * len(rest) and len(right) <= 0.1 * len(rest)


def judge(masks: dict[str, np.ndarray], source: str) -> tuple[bool, list[str]]:
    """Look at all masks of a capture (name -> (h, w) small mask).

    Returns whether they are inverted, and the names of photos whose mask is empty. Raises UserError
    when the masks tell nothing (all black, all white) or contradict each other. source: where they
    come from, for the message.
    """
    empty = [n for n, m in masks.items() if (m > 0.5).mean() < 1e-4]
    full = [n for n, m in masks.items() if (m > 0.5).mean() > 0.999]
    if len(empty) == len(masks):
        raise UserError(
            "all masks are black",
            f"{source} marks no pixel of any photo as the object",
            "write white on the object, or use --masks none",
        )
    if len(full) == len(masks):
        raise UserError(
            "all masks are white",
            f"{source} marks every pixel of every photo as the object",
            "write black off the object, or use --masks none",
        )
    rest = {n: m for n, m in masks.items() if n not in empty and n not in full}
    inverted = [n for n, m in rest.items() if looks_inverted(m)]
    turned = [n for n, m in rest.items() if n in inverted or _is_negative(m)]
    if rest and (len(inverted) >= 0.8 * len(rest) or _most(turned, rest, inverted)):
        return True, full  # of an inverted set, the all-white ones are the empty ones
    if len(inverted) > max(1, 0.2 * len(rest)):
        raise UserError(
            f"{len(inverted)} of {len(masks)} masks look inverted, the others do not",
            f"they are white at the border and black in the middle, for example that of {inverted[0]}",
            f"invert them: white is the object ({source})",
        )
    if len(empty) > 0.5 * len(masks):
        raise UserError(
            f"{len(empty)} of {len(masks)} masks are black",
            f"for example that of {empty[0]}",
            f"write white on the object ({source})",
        )
    return False, empty
