"""Checks of this machine, and for each missing part the command that installs it."""

from __future__ import annotations

import glob
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from relit.device import LLVM_FIX, LLVM_PATTERNS, MIN_LLVM, OPTIX_FIX, find_libllvm, has_optix
from relit.errors import EXIT_ENVIRONMENT, EXIT_OK
from relit.log import available_memory, readable_bytes

MEMORY_NEEDED = 4e9  # bytes; quality standard stays below it
DISK_NEEDED = 1e9  # bytes of a run folder with its checkpoints, generously
PROBE_SECONDS = 120  # a cold start of the compiler on a slow machine takes a tenth of this

# One kernel forward and backward against a central difference, on one backend. In a process of its
# own: an old libLLVM aborts the process instead of raising.
PROBE = """
import sys
import drjit as dr
from relit.device import use_device
chosen = use_device(sys.argv[1])
if chosen == "cuda":
    from drjit.cuda.ad import Float, TensorXf
else:
    from drjit.llvm.ad import Float, TensorXf
grid = dr.linspace(Float, 0.2, 1.7, 64)
def loss(shift):
    at = dr.linspace(Float, 0, 50, 256) + shift
    low = dr.floor(at)
    index, t = dr.uint32_array_t(Float)(low), at - low
    value = dr.fma(t, dr.gather(Float, grid, index + 1) - dr.gather(Float, grid, index), dr.gather(Float, grid, index))
    return dr.mean(dr.sin(value * value) * dr.maximum(value, 0.5))
x = Float(0.3)
dr.enable_grad(x)
dr.backward(loss(x))
step = 0.02
difference = (loss(Float(0.3 + step)) - loss(Float(0.3 - step))) / (2 * step)
print("gradient", dr.grad(x)[0], difference[0])
"""


@dataclass(frozen=True)
class Check:
    """One line of the report. ok: False for a missing part that Relit needs, None for an optional
    one. fix: the command that installs it, or ''."""

    name: str
    ok: bool | None
    found: str
    fix: str = ""


def examine(folder: Path = Path(".")) -> list[Check]:
    """Run all checks. folder: where runs will be written; its disk is checked."""
    llvm, cuda = _llvm(), _cuda()
    wheels = _wheels()
    checks = [_python(), wheels, llvm, *cuda]
    if wheels.ok:
        if llvm.ok:
            checks.append(_gradient("cpu"))
        if cuda[0].ok:
            checks.append(_gradient("cuda"))
    checks += [_memory(), _cores(), _disk(folder), _cache(), *_extras()]
    return checks


def doctor_exit_code(checks: list[Check]) -> int:
    """Exit code: 0 if a reconstruction can run on the CPU or the GPU, else 5."""
    by_name = {c.name: c for c in checks}
    works = any(by_name[n].ok for n in ("gradient on cpu", "gradient on cuda") if n in by_name)
    needed = all(
        c.ok is not False
        for c in checks
        if c.name not in ("libLLVM", "gradient on cpu", "gradient on cuda")
    )
    return EXIT_OK if works and needed else EXIT_ENVIRONMENT


def doctor_text(checks: list[Check]) -> str:
    """The report as text: all checks, then the commands that install what is missing."""
    marks = {True: "ok      ", False: "MISSING ", None: "-       "}
    width = max(len(c.name) for c in checks)
    lines = [f"{marks[c.ok]}{c.name.ljust(width)}  {c.found}" for c in checks]
    fixes = [f"  {c.name}: {c.fix}" for c in checks if c.ok is False and c.fix]
    optional = [f"  {c.name}: {c.fix}" for c in checks if c.ok is None and c.fix]
    if fixes:
        lines += ["", "to fix:", *fixes]
    if optional:
        lines += ["", "optional:", *optional]
    lines += [
        "",
        "Relit can run on this machine."
        if doctor_exit_code(checks) == EXIT_OK
        else "Relit cannot run on this machine yet.",
    ]
    return "\n".join(lines)


def doctor_json(checks: list[Check]) -> str:
    """{"ok": bool, "checks": [{name, ok, found, fix}]}"""
    return json.dumps(
        {"ok": doctor_exit_code(checks) == EXIT_OK, "checks": [asdict(c) for c in checks]}, indent=2
    )


# ---------------------------------------------------------------- the checks


def _python() -> Check:
    good = (3, 10) <= sys.version_info[:2] <= (3, 13)
    return Check(
        "Python",
        good,
        f"{platform.python_version()}, {sys.executable}",
        "" if good else "make setup PYTHON=python3.12",
    )


def _wheels() -> Check:
    try:
        wanted = importlib.metadata.requires("relit") or []
    except importlib.metadata.PackageNotFoundError:
        return Check("wheels", False, "relit is not installed in this Python", "make setup")
    names = [
        re.split(r"[^A-Za-z0-9_.-]", r)[0]
        for r in wanted
        if "extra ==" not in r and "python_version" not in r
    ]
    missing: list[str] = []
    versions: dict[str, str] = {}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        return Check("wheels", False, f"not installed: {', '.join(missing)}", "make setup")
    named = ", ".join(f"{name} {versions[name]}" for name in ("mitsuba", "numpy", "pycolmap"))
    return Check("wheels", True, f"{named}, all {len(names)} found")


def _llvm() -> Check:
    path = find_libllvm()
    if path:
        number = re.search(r"libLLVM[-.a-z]*([0-9.]+)", Path(path).resolve().name)
        return Check(
            "libLLVM",
            True,
            f"{number.group(1).strip('.') if number else 'version unknown'}, {path}",
        )
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return Check(
            "libLLVM",
            False,
            f"DRJIT_LIBLLVM_PATH names a file that does not exist: {given}",
            "unset DRJIT_LIBLLVM_PATH",
        )
    old = sorted({p for pattern in LLVM_PATTERNS for p in glob.glob(pattern)})
    found = f"only versions below {MIN_LLVM}: {', '.join(old)}" if old else "not found"
    return Check("libLLVM", False, found, LLVM_FIX)


def _cuda() -> list[Check]:
    smi = shutil.which("nvidia-smi")
    if not smi:
        return [Check("CUDA", None, "no NVIDIA driver found; the CPU is used")]
    query = _output([smi, "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"])
    if not query:
        return [
            Check(
                "CUDA",
                None,
                "nvidia-smi prints nothing; the CPU is used",
                "nvidia-smi",
            )
        ]
    found = "; ".join(query.splitlines())
    if not has_optix():
        return [
            Check(
                "CUDA",
                None,
                f"{found}, without OptiX (libnvoptix.so.1), needed for ray tracing; the CPU is used",
                OPTIX_FIX,
            )
        ]
    return [Check("CUDA", True, found)]


def _gradient(device: str) -> Check:
    name = f"gradient on {device}"
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE, device],
            capture_output=True,
            text=True,
            timeout=PROBE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return Check(name, False, f"no result after {PROBE_SECONDS} s")
    fix = LLVM_FIX if device == "cpu" else "update the NVIDIA driver, or use --device cpu"
    last = next((line for line in done.stdout.splitlines() if line.startswith("gradient ")), "")
    if done.returncode or not last:
        last_line = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        how = (
            f"killed by signal {-done.returncode}"
            if done.returncode < 0
            else f"exit code {done.returncode}"
        )
        return Check(name, False, f"the test process ended ({how}): {last_line}", fix)
    gradient, difference = (float(x) for x in last.split()[1:])
    off = abs(gradient - difference) / max(abs(difference), 1e-9)
    found = f"{gradient:.5f}, finite difference {difference:.5f} ({100 * off:.2f} % error)"
    return Check(name, off < 0.02, found, "" if off < 0.02 else fix)


def _memory() -> Check:
    free = available_memory()
    if free is None:
        return Check("memory", None, "unknown on this system")
    if free < MEMORY_NEEDED:
        found = f"{readable_bytes(free)} available, quality standard needs up to 4 GB"
        return Check("memory", None, found, "close other programs, or use --quality draft")
    return Check("memory", True, f"{readable_bytes(free)} available")


def _cores() -> Check:
    count = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return Check("cores", True, f"{count}, {platform.machine()}, {platform.system()}")


def _disk(folder: Path) -> Check:
    free = shutil.disk_usage(folder).free
    if free < DISK_NEEDED:
        return Check(
            "disk",
            False,
            f"{readable_bytes(free)} free in {folder.resolve()}",
            "free 1 GB, or use -o on another disk",
        )
    return Check("disk", True, f"{readable_bytes(free)} free in {folder.resolve()}")


def _cache() -> Check:
    """Dr.Jit caches compiled kernels in ~/.drjit; without it each start compiles all kernels."""
    home = Path(os.path.expanduser("~")) / ".drjit"
    try:
        home.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=home):
            pass
    except OSError as error:
        found = f"{home} is not writable ({error.strerror}): each start compiles all kernels"
        return Check("kernel cache", None, found, "export HOME=/path/to/a/writable/folder")
    return Check("kernel cache", True, str(home))


def _extras() -> list[Check]:
    def module(name: str, imports: tuple[str, ...], wheels: str, what: str) -> Check:
        have = all(importlib.util.find_spec(i) is not None for i in imports)
        found = what if have else f"{what}: not installed"
        return Check(
            name,
            True if have else None,
            found,
            "" if have else f"{sys.executable} -m pip install {wheels}",
        )

    node = shutil.which("node")
    return [
        module("ffmpeg", ("imageio_ffmpeg",), "imageio-ffmpeg", "H.264 videos (otherwise MPEG-4)"),
        module(
            "segmenter",
            ("onnxruntime",),
            "onnxruntime",
            "masks by a segmentation network",
        ),
        module("HEIC", ("pillow_heif",), "pillow-heif", "HEIC photos of phones"),
        module("RAW", ("rawpy",), "rawpy", "raw photos of cameras"),
        Check("node", True, node)
        if node
        else Check(
            "node", None, "no node for the glTF validator", "sudo apt-get install -y nodejs npm"
        ),
    ]


def _output(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
