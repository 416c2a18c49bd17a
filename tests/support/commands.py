"""The command line as the tests run it."""

from __future__ import annotations

from relit.cli import main as cli


def relit(capsys, *argv):
    code = cli.main([str(a) for a in argv])
    out = capsys.readouterr()
    return code, out.out, out.err


def answered(code, err, expected, said):
    """One complete answer and no stack trace."""
    assert code == expected, err
    assert "Traceback" not in err and "error: " in err and said in err
    assert "why: " in err or "fix: " in err


TINY = {
    "levels": 24,
    "level_steps": 20,
    "rays": 256,
    "faces": 600,
    "texture": 32,
    "surface_steps": 8,
    "points": 64,
    "directions": 8,
    "light": 8,
}


# the command line with a small report
JOB = """
import sys
from relit.report import page as report
report.SIDE, report.STILLS, report.SPP, report.SPP_COMPARED, report.VIEWS = 24, 2, 1, 1, 1
from relit.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
