"""The command line: verbs, flags in any order, suggestions, exit codes, and no stack trace for a
user."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Literal

import pytest

from relit.cli import main as cli
from relit.cli import verbs
from relit.errors import UserError
from relit.settings import convert, with_pairs, with_values


def run(capsys, *argv):
    code = cli.main([str(a) for a in argv])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_help_is_quick():
    before = os.times()
    subprocess.run(
        [sys.executable, "-m", "relit", "reconstruct", "--help"], check=True, capture_output=True
    )
    after = os.times()
    spent = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    job = "import sys; from relit.cli.main import main; main(['evaluate', '--help']); "
    job += "print('LOADED', {'mitsuba', 'scipy', 'cv2'} & set(sys.modules))"
    out = subprocess.run(
        [sys.executable, "-c", job], check=True, capture_output=True, text=True
    ).stdout
    assert out.endswith("LOADED set()\n")
    assert spent < 1.0  # of processor time, which other work leaves alone; 0.2 s usually


def test_overview_lists_every_verb(capsys):
    for argv in ((), ("--help",), ("-h",)):
        code, out, _ = run(capsys, *argv)
        assert code == 0
        assert all(f"  {verb} " in out for verb in verbs.VERBS)
    assert run(capsys, "--version")[1].startswith("relit 0.")


@pytest.mark.parametrize("verb", list(verbs.VERBS))
def test_every_verb_has_help_with_common_flags_first(capsys, verb):
    code, out, _ = run(capsys, verb, "--help")
    assert code == 0 and f"usage: relit {verb}" in out
    if "more flags:" in out:
        assert out.index("common flags:") < out.index("more flags:")


@pytest.mark.parametrize(
    "argv, said",
    [
        (["recnstruct", "x"], "unknown verb 'recnstruct'. Did you mean 'reconstruct'?"),
        (["insrt", "x"], "unknown verb 'insrt'. Did you mean 'insert'?"),
        (["--qualty", "draft", "reconstruct"], "unknown flag '--qualty' before the verb"),
        (
            ["reconstruct", "x", "-o", "y", "--qualty", "draft"],
            "unknown flag '--qualty'. Did you mean '--quality'?",
        ),
        (["reconstruct", "x", "--overwite"], "Did you mean '--overwrite'?"),
        (
            ["reconstruct", "x", "-o", "y", "--quality", "drft"],
            "--quality drft is not known. Did you mean 'draft'?",
        ),
        (["reconstruct", "x", "-o", "y", "--qual", "draft"], "unknown flag '--qual'"),
        (["reconstruct", "x"], "missing argument: -o/--out"),
        (["reconstruct", "-o", "y"], "missing argument: input"),
        (["reconstruct", "x", "y", "-o", "z"], "unexpected argument 'y'"),
        (["reconstruct", "x", "-o", "y", "--sphere", "1,2,3"], "'1,2,3' is not X,Y,Z,RADIUS"),
        (["reconstruct", "x", "-o", "y", "--sphere", "0,0,0,-1"], "is not X,Y,Z,RADIUS"),
        (["reconstruct", "x", "-o", "y", "--seed", "many"], "invalid int value: 'many'"),
        (
            ["reconstruct", "x", "-o", "y", "--capture", "flsh"],
            "--capture flsh is not known. Did you mean 'flash'?",
        ),
        (
            ["reconstruct", "x", "-o", "y", "--config", "nowhere.toml"],
            "configuration file does not exist",
        ),
        (
            ["synthesize", "flsh", "--asset", "a", "--light", "b", "-o", "c"],
            "Did you mean 'flash'?",
        ),
        (
            ["synthesize", "multiview", "--asset", "a", "--light", "b", "c", "-o", "d"],
            "has one light",
        ),
        (
            ["synthesize", "multview", "--asset", "a", "--light", "b", "-o", "c"],
            "Did you mean 'multiview'?",
        ),
        (["export", "x", "-o", "y.stl"], "cannot be told from the ending"),
        (["evaluate", "x"], "missing argument: --truth"),
        (
            ["relight", "x", "--light", "l.hdr", "-o", "y", "--albedo-scale", "1,2"],
            "'1,2' is not one number or R,G,B",
        ),
        (["relight", "x", "--light", "l.hdr", "-o", "y", "--albedo-scale", "0"], "each above 0"),
    ],
)
def test_wrong_usage_is_exit_code_2(capsys, tmp_path, monkeypatch, argv, said):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *argv)
    assert code == 2 and said in err and "Traceback" not in err and out == ""
    assert err.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_short_flags():
    words = "-q draft -d cpu -s texture=64 -s rays=9 -c a.toml -f photos -o run".split()
    args = verbs.parser_for("reconstruct").parse(words)
    assert (args.quality, args.device, args.pairs) == ("draft", "cpu", ["texture=64", "rays=9"])
    assert (args.config, args.out, args.overwrite) == (Path("a.toml"), Path("run"), True)
    assert verbs.parser_for("benchmark").parse(["multiview", "-q", "high"]).quality == "high"
    with pytest.raises(UserError, match="--quality drft is not known"):
        verbs.parser_for("reconstruct").parse(["-q", "drft", "photos", "-o", "run"])


def test_flags_in_any_order_and_negative_values(tmp_path):
    parser = verbs.parser_for("reconstruct")
    words = [
        "--quality",
        "draft",
        "photos",
        "--set",
        "a=1",
        "-o",
        "run",
        "--sphere",
        "-1,.5,0,2",
        "--set=b=2",
    ]
    args = parser.parse(words)
    assert (str(args.input), str(args.out), args.quality) == ("photos", "run", "draft")
    assert args.sphere == (-1.0, 0.5, 0.0, 2.0) and args.pairs == ["a=1", "b=2"]
    assert verbs.parser_for("reconstruct").parse(["photos", "-o", "run"]).quality is None


def test_each_kind_of_capture_has_its_own_flags(capsys, monkeypatch, tmp_path):
    """The kind is the first positional, wherever it stands; another kind's flags are unknown to
    it."""
    from relit.cli.parser import Kind
    from relit.cli.synthesizers import SYNTHESIZERS

    seen = []
    flags = lambda parser: parser.common.add_argument("--count", type=int, default=10)  # noqa: E731
    monkeypatch.setitem(
        SYNTHESIZERS,
        "duplicates",
        Kind(flags, lambda args: seen.append((args.kind, args.count, args.asset.name))),
    )
    common = ["--asset", "a.glb", "-o", str(tmp_path / "out")]
    assert run(capsys, "synthesize", "duplicates", *common, "--count", "6")[0] == 0
    assert run(capsys, "synthesize", *common, "--count=7", "duplicates")[0] == 0
    assert seen == [("duplicates", 6, "a.glb"), ("duplicates", 7, "a.glb")]
    code, _, err = run(capsys, "synthesize", "duplicates", *common, "--views", "6")
    assert code == 2 and "unknown flag '--views'" in err
    code, _, err = run(
        capsys, "synthesize", "multiview", *common, "--light", "l.hdr", "--count", "6"
    )
    assert code == 2 and "unknown flag '--count'" in err
    assert "--count" in run(capsys, "synthesize", "duplicates", "--help")[1]
    assert "--views" in run(capsys, "synthesize", "--help")[1]


def stub(monkeypatch, act):
    monkeypatch.setitem(verbs.VERBS, "doctor", verbs.Verb("stub", lambda parser: None, act))


def test_user_error_is_printed_in_full_with_its_code(capsys, monkeypatch):
    def act(args):
        raise UserError(
            "3 photos of 60 are empty", "the camera ran out of power", "remove them: a.jpg", code=4
        )

    stub(monkeypatch, act)
    code, _, err = run(capsys, "doctor")
    assert code == 4
    assert (
        err
        == "error: 3 photos of 60 are empty\nwhy: the camera ran out of power\nfix: remove them: a.jpg\n"
    )
    monkeypatch.setenv("RELIT_DEBUG", "1")
    assert "Traceback" in run(capsys, "doctor")[2]


def test_an_unexpected_error_is_one_line_and_a_file(capsys, monkeypatch, tmp_path):
    def act(args):
        raise KeyError("lost")

    stub(monkeypatch, act)
    code, _, err = run(capsys, "doctor")
    path = err.split("report it with ")[1].strip()
    assert code == 1 and "Traceback" not in err and "KeyError" in err
    text = Path(path).read_text()
    assert "Traceback" in text and "in act" in text
    (tmp_path / "log.txt").write_text("before\n")
    monkeypatch.setitem(
        verbs.VERBS, "doctor", verbs.Verb("stub", lambda p: p.add_argument("-o"), act)
    )
    _, _, err = run(capsys, "doctor", "-o", tmp_path)
    assert str(tmp_path / "log.txt") in err
    assert (tmp_path / "log.txt").read_text().startswith("before\n") and "in act" in (
        tmp_path / "log.txt"
    ).read_text()


@pytest.mark.parametrize(
    "error, code, said",
    [
        (OSError(28, "No space left on device"), 5, "the disk is full"),
        (MemoryError("Unable to allocate 80 GiB"), 5, "out of memory: Unable to allocate"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_of_the_machine(capsys, monkeypatch, error, code, said):
    def act(args):
        raise error

    stub(monkeypatch, act)
    got, _, err = run(capsys, "doctor")
    assert got == code and said in err and "Traceback" not in err


def test_sigterm_is_exit_code_143(capsys, monkeypatch):
    import os

    def act(args):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)

    before = signal.getsignal(signal.SIGTERM)
    stub(monkeypatch, act)
    assert run(capsys, "doctor")[0] == 143
    assert signal.getsignal(signal.SIGTERM) is before


def test_doctor_prints_json(capsys, monkeypatch):
    from relit import doctor

    checks = [
        doctor.Check("gradient on cpu", True, "fine"),
        doctor.Check("disk", False, "full", "rm x"),
    ]
    monkeypatch.setattr(doctor, "examine", lambda: checks)
    code, out, _ = run(capsys, "doctor", "--json")
    assert code == 5 and json.loads(out)["checks"][1]["fix"] == "rm x"


def test_outputs_are_not_overwritten(capsys, tmp_path):
    there = tmp_path / "a.glb"
    there.write_bytes(b"mine")
    code, _, err = run(capsys, "export", tmp_path, "-o", there)
    assert code == 3 and "nothing was overwritten" in err and there.read_bytes() == b"mine"


# ---------------------------------------------------------------- settings


@dataclasses.dataclass(frozen=True)
class Options:
    rate: float = 0.5
    steps: tuple[int, ...] = (1, 2)
    band: tuple[float, float] = (0.0, 1.0)
    shadows: bool = True
    light: Literal["map", "none"] = "map"
    limit: int | None = None

    def __post_init__(self):
        if self.rate < 0:
            raise ValueError("rate is negative")


def test_settings_are_parsed_by_type():
    got = with_pairs(
        Options(),
        ["rate=1e-2", "steps=3,4,5", "band=[.5, 2]", "shadows=off", "light=none", "limit=7"],
    )
    assert got == Options(0.01, (3, 4, 5), (0.5, 2.0), False, "none", 7)
    assert with_values(got, {"limit": None, "steps": [8]}, "file") == Options(
        0.01, (8,), (0.5, 2.0), False, "none", None
    )


@pytest.mark.parametrize(
    "pair, said",
    [
        ("rat=1", "unknown key 'rat'. Did you mean 'rate'?"),
        ("rate", "'=' is missing"),
        ("rate=fast", "rate=fast is not valid; expected number"),
        ("steps=1.5", "expected list of whole number"),
        ("band=1,2,3", "expected list of number"),
        ("shadows=maybe", "expected true or false"),
        ("light=sun", "expected one of map, none"),
        ("rate=-1", "rate is negative"),
    ],
)
def test_wrong_settings_are_exit_code_2(pair, said):
    with pytest.raises(UserError) as caught:
        with_pairs(Options(), [pair])
    assert said in caught.value.what and caught.value.code == 2


def test_convert_refuses_what_it_does_not_know():
    with pytest.raises(ValueError):
        convert("x", types.SimpleNamespace)
    with pytest.raises(ValueError):
        convert(True, int)


@pytest.mark.parametrize("stop, code", [("KeyboardInterrupt", 130), ("Terminated", 143)])
def test_a_stopped_command_ends_with_its_code_whatever_native_threads_do(stop, code):
    """A stop may come while a native module is half loaded; what the interpreter does at its end
    then aborts."""
    job = f"""
import atexit, os
from relit.cli import main as cli
from relit import run
atexit.register(os.abort)
def stopped(argv): raise {"run.Terminated" if stop == "Terminated" else stop}
cli._dispatch = stopped
cli.command()
"""
    done = subprocess.run([sys.executable, "-c", job], capture_output=True, text=True)
    assert done.returncode == code and done.stderr.splitlines()[-1] == (
        "terminated" if stop == "Terminated" else "interrupted"
    )
