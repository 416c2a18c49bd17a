"""Figures of a reconstruction against the truth."""

from relit.evaluate.protocols import evaluate

__all__ = ["evaluate"]
