"""Tracing: the operations that NumPy code does with its arguments, for exports and for bounds over boxes."""

from hyrl_mj.tracing.trace import trace
from hyrl_mj.tracing.traced_array import EVALUATED, Operation, Program, Traced, apply
from hyrl_mj.tracing.vocabulary import BATCH, ELEMENTWISE

__all__ = [
    "BATCH",
    "ELEMENTWISE",
    "EVALUATED",
    "Operation",
    "Program",
    "Traced",
    "apply",
    "trace",
]
