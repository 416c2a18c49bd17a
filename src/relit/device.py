"""Choosing where Dr.Jit runs. Call `use_device` once, before anything that imports Mitsuba's
types."""

from __future__ import annotations

import ctypes
import glob
import os
import signal
import sys
import threading
from pathlib import Path

from relit.errors import EXIT_ENVIRONMENT, UserError

MIN_LLVM = 17  # older ones abort the process on x86-64 with AVX-512: "Cannot select: fmaximum"
LLVM_PATTERNS = [
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
]
VARIANTS = {"cpu": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
LLVM_FIX = "sudo apt-get install -y libllvm19   (Debian, Ubuntu; libLLVM 17 or newer), or set DRJIT_LIBLLVM_PATH to the file"
OPTIX_FIX = "in a container: NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility; elsewhere: sudo apt-get install -y libnvidia-gl-VERSION"


def find_libllvm() -> str | None:
    """Path of the newest libLLVM (>= MIN_LLVM) shared library on this machine, or None.
    `DRJIT_LIBLLVM_PATH` goes first."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given if Path(given).exists() else None
    found = sorted({p for pattern in LLVM_PATTERNS for p in glob.glob(pattern)}, key=_llvm_version)
    return found[-1] if found and _llvm_version(found[-1]) >= (MIN_LLVM,) else None


def _llvm_version(path: str) -> tuple[int, ...]:
    digits = "".join(
        c if c.isdigit() else " " for c in Path(path).resolve().name.replace("libLLVM", "")
    )
    return tuple(int(x) for x in digits.split()) or (0,)


def has_optix() -> bool:
    """Is OptiX there, which comes with NVIDIA's driver? Without it a GPU computes but traces no
    rays, as in many containers."""
    if sys.platform == "win32":
        return True  # the driver keeps it where only its own search finds it
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1")
    except OSError:
        return False
    return True


def use_device(device: str = "auto") -> str:
    """Set Mitsuba's variant for `device` ('auto', 'cpu', 'cuda') and return 'cpu' or 'cuda'.

    Raises UserError (exit code 5) when the device is not there. 'auto' takes the GPU when there is
    one that traces rays.
    """
    llvm = find_libllvm()
    if llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import drjit as dr
    import mitsuba as mi

    has_cuda = dr.has_backend(dr.JitBackend.CUDA)
    if device not in ("auto", "cpu", "cuda"):
        raise UserError(f"unknown device '{device}'", fix="choose auto, cpu or cuda", code=2)
    if device == "cuda" and not has_cuda:
        raise UserError(
            "no CUDA device is usable",
            "--device cuda needs an NVIDIA GPU and a driver (libcuda.so.1); none answered",
            "install the driver, or run with --device cpu",
            code=EXIT_ENVIRONMENT,
        )
    traces = device != "cpu" and has_cuda and has_optix()
    if device == "cuda" and not traces:
        why = "OptiX (libnvoptix.so.1), a part of NVIDIA's driver, is not there"
        raise UserError("the GPU traces no rays", why, OPTIX_FIX, code=EXIT_ENVIRONMENT)
    chosen = "cuda" if traces else "cpu"
    if chosen == "cpu" and not (llvm and dr.has_backend(dr.JitBackend.LLVM)):
        why = f"Relit compiles its kernels with it on the CPU; it is not in any wheel; version {MIN_LLVM} or newer is needed"
        raise UserError("no usable libLLVM was found", why, LLVM_FIX, code=EXIT_ENVIRONMENT)
    mi.set_variant(VARIANTS[chosen])
    mi.set_log_level(mi.LogLevel.Error)
    return chosen


def load_pycolmap():
    """pycolmap, with SIGTERM's handler as it was: its import installs glog's, which ends the
    process with a stack trace."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread() and before is not None:
        signal.signal(signal.SIGTERM, before)
    return pycolmap
