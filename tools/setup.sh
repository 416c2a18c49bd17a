#!/usr/bin/env bash
# Creates .venv with Python 3.10-3.13, Relit, its wheels and libLLVM. Run it through `make setup`.
# Environment: PYTHON (interpreter), VENV (folder of the virtual environment, default .venv).
set -euo pipefail
cd "$(dirname "$0")/.."
VENV=${VENV:-.venv}
STAMP=$VENV/.relit-setup # contains the path of creation: a virtual environment cannot be moved

if [ "$(cat "$STAMP" 2>/dev/null)" = "$PWD" ] && [ "$STAMP" -nt pyproject.toml ] && [ "$STAMP" -nt tools/setup.sh ] && [ -x "$VENV/bin/relit" ]; then
    exit 0
fi

say() { printf '%s\n' "$*" >&2; }
fail() { # what, why, fix
    say "error: $1"
    say "why: $2"
    say "fix: $3"
    exit 5
}

as_root() { # run a command as root; false if that is not possible
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then sudo -n "$@"; else return 1; fi
}

apt_install() { # true only if all packages were installed
    command -v apt-get >/dev/null || return 1
    as_root true || return 1
    if as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >/dev/null 2>&1; then return 0; fi
    if [ -z "${UPDATED:-}" ]; then
        UPDATED=1
        as_root apt-get update -q >/dev/null 2>&1 || say "apt-get update failed; using the existing package lists"
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >/dev/null 2>&1 && return 0
    fi
    return 1
}

supported() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

find_python() {
    local name
    for name in "${PYTHON:-}" python3 python3.12 python3.13 python3.11 python3.10; do
        if [ -n "$name" ] && command -v "$name" >/dev/null && supported "$name"; then
            command -v "$name"
            return
        fi
    done
    fail "no Python 3.10-3.13 was found" "the wheels exist for these versions only" "sudo apt-get install -y python3 python3-venv, or make setup PYTHON=/path/to/python3.12"
}

make_venv() {
    if [ -e "$STAMP" ] && [ "$(cat "$STAMP")" != "$PWD" ]; then rm -rf "$VENV"; fi
    if [ -x "$VENV/bin/python" ] && supported "$VENV/bin/python" && "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then return; fi
    local python
    python=$(find_python)
    say "virtual environment: $VENV with $("$python" --version)"
    "$python" -m venv --clear "$VENV" >/dev/null 2>&1 && return
    local version
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    apt_install "python$version-venv" || apt_install python3-venv || true
    "$python" -m venv --clear "$VENV" >/dev/null 2>&1 ||
        fail "Python's venv module does not work" "Debian and Ubuntu have it in a separate package" "sudo apt-get install -y python$version-venv"
}

install_wheels() {
    say "wheels: pip install -e .[dev]"
    "$VENV/bin/python" -m pip install -q --disable-pip-version-check -e '.[dev]' ||
        fail "pip could not install the wheels" "see its message above; often the package index is unreachable" \
            "check the network or set PIP_INDEX_URL, then run make setup again"
}

find_llvm() { "$VENV/bin/python" -c 'from relit.device import find_libllvm as f; print(f() or "")'; }

install_llvm() {
    if [ -n "$(find_llvm)" ]; then return; fi
    say "libLLVM 17 or newer: not found, trying apt-get"
    local package
    for package in libllvm19 libllvm20 libllvm18 libllvm17t64 libllvm17; do
        if apt_install "$package" && [ -n "$(find_llvm)" ]; then
            say "libLLVM: installed $package"
            return
        fi
    done
    if [ -e /proc/driver/nvidia/version ] || ldconfig -p 2>/dev/null | grep -q libcuda.so.1; then
        say "libLLVM is missing: only --device cuda will work. To fix: sudo apt-get install -y libllvm19"
        return
    fi
    fail "libLLVM 17 or newer is missing" "Dr.Jit compiles kernels with it; no wheel contains it, and apt-get could not install it" \
        "sudo apt-get install -y libllvm19, then run make setup again (or set DRJIT_LIBLLVM_PATH)"
}

make_venv
install_wheels
install_llvm
printf %s "$PWD" >"$STAMP"
say "ready: $VENV/bin/relit doctor"
