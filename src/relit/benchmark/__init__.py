"""`relit benchmark SUITE`: synthesize (cached) + reconstruct + evaluate over a suite, one table.

suites/       what is measured: objects, lights, bars, ablations of each suite
splits.py     objects that settings are chosen on, and that results are reported on
photographed.py  synthesizers of captures through a camera model, as suites call them
runner.py     the run over a suite
progress.py   parts of a run, and how a stopped one goes on
cost.py       time and memory of a command
results.py    means, verdicts, tables
records.py    one JSON file a run
report.py     RESULTS.md from these files
published.py  values that papers print
"""

from relit.benchmark.runner import SuiteOptions, run_seeds, run_suite
from relit.benchmark.suites import SUITES, Item, Suite

__all__ = ["SUITES", "Item", "Suite", "SuiteOptions", "run_seeds", "run_suite"]
