"""Scores of a bundle against ground truth."""

from splatart_ns.evaluation.evaluate import evaluate
from splatart_ns.evaluation.tables import format_tables

__all__ = ["evaluate", "format_tables"]
