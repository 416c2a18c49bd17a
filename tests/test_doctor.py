"""`relit doctor` finds what is there, and says what is missing with the command that mends it."""

from __future__ import annotations

import json
import os
import sys

import pytest

from relit import device, doctor
from relit.errors import EXIT_ENVIRONMENT, EXIT_OK, UserError


def named(checks):
    return {c.name: c for c in checks}


def test_checks_of_this_machine(tmp_path):
    checks = doctor.examine(tmp_path)
    by_name = named(checks)
    assert by_name["libLLVM"].ok and by_name["gradient on cpu"].ok
    assert doctor.doctor_exit_code(checks) == EXIT_OK
    said = json.loads(doctor.doctor_json(checks))
    assert said["ok"] and {"Python", "wheels", "libLLVM", "CUDA", "memory", "disk", "ffmpeg"} <= {
        c["name"] for c in said["checks"]
    }
    text = doctor.doctor_text(checks)
    assert "Relit can run on this machine." in text and str(tmp_path) in text


def test_a_missing_libllvm_is_named_with_its_command(monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "nowhere.so"))
    checks = doctor.examine(tmp_path)
    assert named(checks)["libLLVM"].ok is False and "nowhere.so" in named(checks)["libLLVM"].found
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
    (tmp_path / "libLLVM-15.so.1").touch()
    for module in (device, doctor):
        monkeypatch.setattr(module, "LLVM_PATTERNS", [str(tmp_path / "libLLVM*.so*")])
    checks = doctor.examine(tmp_path)
    assert "only versions below 17" in named(checks)["libLLVM"].found
    if named(checks)["CUDA"].ok is None:
        assert doctor.doctor_exit_code(checks) == EXIT_ENVIRONMENT
        assert "libllvm19" in doctor.doctor_text(checks) and "cannot run" in doctor.doctor_text(
            checks
        )


def test_use_device_says_what_is_missing(monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "nowhere.so"))
    with pytest.raises(UserError, match="libLLVM") as caught:
        device.use_device("cpu")
    assert caught.value.code == EXIT_ENVIRONMENT and "apt-get install" in caught.value.fix


def test_gpu_without_optix_is_not_used(monkeypatch, tmp_path):
    """As in a container that was given the computing half of the driver only."""
    import drjit as dr
    import mitsuba as mi

    monkeypatch.setattr(dr, "has_backend", lambda backend: True)
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", str(tmp_path / "libnvoptix.so.1"))
    variant = mi.variant()
    assert device.use_device("auto") == "cpu"
    mi.set_variant(variant)  # the other tests keep theirs
    with pytest.raises(UserError, match="traces no rays") as caught:
        device.use_device("cuda")
    assert caught.value.code == EXIT_ENVIRONMENT and "graphics" in caught.value.fix
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'a card, 580.1, 8192 MiB'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    (check,) = doctor._cuda()
    assert check.ok is None and "a card" in check.found and "without OptiX" in check.found


@pytest.mark.parametrize(
    "program, said",
    [
        ("import os; os.abort()", "killed by signal 6"),
        ("print('gradient', 1.0, 2.0)", "50.00 % error"),
        ("raise SystemExit(3)", "exit code 3"),
    ],
)
def test_a_dying_or_wrong_compiler_is_reported_and_survived(monkeypatch, program, said):
    monkeypatch.setattr(doctor, "PROBE", program)
    check = doctor._gradient("cpu")
    assert check.ok is False and said in check.found and check.fix


def test_missing_wheels_and_extras(monkeypatch, tmp_path):
    """Of an installation that requires what is not there; modules and PATH are empty."""
    installed = tmp_path / "relit-1.0.dist-info"
    installed.mkdir()
    requires = ["numpy", "no-such-wheel>=2", 'other; extra == "dev"']
    lines = ["Metadata-Version: 2.1", "Name: relit", "Version: 1.0"]
    (installed / "METADATA").write_text(
        "\n".join([*lines, *(f"Requires-Dist: {r}" for r in requires)]) + "\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    check = doctor._wheels()
    assert (
        check.ok is False
        and check.found == "not installed: no-such-wheel"
        and check.fix == "make setup"
    )
    for name in ("imageio_ffmpeg", "onnxruntime", "pillow_heif", "rawpy"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setenv("PATH", str(tmp_path))
    extras = doctor._extras()
    assert all(c.ok is None and c.fix for c in extras)
    assert any(c.fix == f"{sys.executable} -m pip install pillow-heif" for c in extras)


def test_little_disk_and_memory(monkeypatch, tmp_path):
    class Usage:
        free = 5e8

    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: Usage)
    monkeypatch.setattr(doctor, "available_memory", lambda: 1e9)
    assert doctor._disk(tmp_path).ok is False and "500 MB" in doctor._disk(tmp_path).found
    assert doctor._memory().ok is None and "draft" in doctor._memory().fix


def test_kernel_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / ".drjit").write_text("a file is in the way")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert doctor._cache().ok is None
