"""`relit benchmark SUITE`: synthesize (cached) + reconstruct + evaluate over a suite, one table.

suites.py     what is measured: objects, lights, bars, ablations of each suite
runner.py     the run over a suite
cost.py       time and memory of a command
results.py    means, verdicts, tables
"""

from relit.benchmark.runner import run_suite
from relit.benchmark.suites import SUITES, Item, Suite

__all__ = ["SUITES", "Item", "Suite", "run_suite"]
