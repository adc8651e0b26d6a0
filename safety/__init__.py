"""Safety: barriers, the quadratic program layer and the filter between policy and world."""

from safety.config import SafetyConfig
from safety.filter import SafetyFilter
from safety.qp import QPSolution, QPStatus, solve_qp

__all__ = ["QPSolution", "QPStatus", "SafetyConfig", "SafetyFilter", "solve_qp"]
