"""Writing pictures, atomically."""

from __future__ import annotations

import errno
import io
import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image as PilImage

from relit.conventions import srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, UserError


def codes_of(array: np.ndarray) -> np.ndarray:
    """[0, 1] -> uint8, rounded."""
    return (
        np.clip(np.nan_to_num(np.asarray(array, dtype=np.float32)), 0.0, 1.0) * 255.0 + 0.5
    ).astype(np.uint8)


def _encode(codes: np.ndarray, suffix: str, quality: int = 93) -> bytes:
    codes = codes[..., 0] if codes.ndim == 3 and codes.shape[2] == 1 else codes
    out = io.BytesIO()
    if suffix == ".png":
        PilImage.fromarray(codes).save(out, "PNG", compress_level=4)
    elif suffix in (".jpg", ".jpeg"):
        PilImage.fromarray(codes[..., :3] if codes.ndim == 3 else codes).save(
            out, "JPEG", quality=quality
        )
    else:
        raise UserError(
            f"cannot write '{suffix}' as an 8-bit picture", fix="name the file .png or .jpg", code=2
        )
    return out.getvalue()


def _srgb_codes(linear: np.ndarray) -> np.ndarray:
    """Linear (H, W), (H, W, 3) or straight-alpha (H, W, 4) -> uint8 sRGB; the alpha channel has no
    curve."""
    linear = np.asarray(linear, dtype=np.float32)
    if linear.ndim == 3 and linear.shape[2] == 4:
        return codes_of(
            np.concatenate([srgb_from_linear(linear[..., :3]), linear[..., 3:]], axis=-1)
        )
    return codes_of(srgb_from_linear(linear))


def encode_jpeg(linear: np.ndarray, quality: int = 90) -> bytes:
    """Linear (H, W[, 3]) -> bytes of an sRGB JPEG."""
    return _encode(_srgb_codes(linear), ".jpg", quality)


def encode_png(linear: np.ndarray) -> bytes:
    """Linear (H, W[, 3 or 4, straight alpha]) -> bytes of an 8-bit sRGB PNG."""
    return _encode(_srgb_codes(linear), ".png")


def write_srgb(path: str | Path, linear: np.ndarray) -> None:
    """Write linear (H, W), (H, W, 3) or straight-alpha (H, W, 4) as an 8-bit sRGB PNG or JPEG,
    atomically."""
    write_bytes(path, _encode(_srgb_codes(linear), Path(path).suffix.lower()))


def write_data(path: str | Path, array: np.ndarray) -> None:
    """Write (H, W[, 1-4]) in [0, 1] as an 8-bit PNG without a transfer curve, atomically."""
    write_bytes(path, _encode(codes_of(array), Path(path).suffix.lower()))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file atomically (temporary file beside it, then rename). Raises UserError (exit code
    5) on a full or read-only disk."""
    with _replacing(Path(path)) as temporary:
        temporary.write_bytes(data)


def write_linear(path: str | Path, array: np.ndarray) -> None:
    """Write (H, W) or (H, W, 1, 3 or 4) linear values, atomically: .exr as float32, .hdr as RGBE (3
    channels only, about 1 % precision)."""
    path = Path(path)
    array = np.ascontiguousarray(array, dtype=np.float32)
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    suffix = path.suffix.lower()
    with _replacing(path) as temporary:
        if suffix == ".exr":
            import OpenEXR

            name = "Y" if array.ndim == 2 else {3: "RGB", 4: "RGBA"}[array.shape[2]]
            head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(head, {name: array}) as f:
                f.write(str(temporary))
        elif suffix == ".hdr" and array.ndim == 3 and array.shape[2] == 3:
            import cv2

            if not cv2.imwrite(str(temporary), array[..., ::-1]):
                raise OSError(errno.EIO, "the file could not be written")
        else:
            raise UserError(
                f"cannot write {array.shape} linear values as '{suffix}'",
                fix="use .exr (1, 3 or 4 channels) or .hdr (3 channels)",
                code=2,
            )


@contextmanager
def _replacing(path: Path):
    """Yield a temporary path in the same folder that takes the place of `path` when the block
    succeeds."""
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=".writing-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        reason = (
            "the disk is full"
            if error.errno in (errno.ENOSPC, errno.EDQUOT)
            else (error.strerror or str(error))
        )
        raise UserError(
            "a file could not be written",
            reason,
            f"free some space or choose another folder: {path}",
            code=EXIT_ENVIRONMENT,
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
