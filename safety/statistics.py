"""What the filter did, summed over a run: the block ``filter`` of summary.json and of eval.json."""

import math

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from envs import keys
from safety.certificate import HOMING
from safety.qp import QPStatus

MARGINS = {
    "min_h_c": keys.BARRIER_ENERGY,
    "min_h_o": keys.BARRIER_OVERCHARGE,
    "min_h_s": keys.BARRIER_COLLISION,
    "min_certificate_margin": keys.BARRIER_CERTIFICATE,
}
"""Least barriers by name: survivability and overcharge (energy), collision (m^2), G - Delta_G (m)."""
FILTER_READS: list[NestedKey] = [
    *(keys.STATUS, keys.LEVEL, keys.CORRECTION, keys.RESIDUAL, keys.OUTSIDE),
    *MARGINS.values(),
]
"""What :func:`filter_numbers` reads; some filters do not write all barriers."""
SUMS = ("robot_steps", "interventions", "correction", "fallbacks", "infeasible", "inaccurate", "outside", "homing")


class FilterStatistics:
    """Running sums over filtered robot-steps."""

    def __init__(self) -> None:
        self.sums = dict.fromkeys(SUMS, 0.0)
        self.max_residual = 0.0
        self.least: dict[str, float] = {}

    def add(self, found: dict[str, float]) -> None:
        """Add what was read of :func:`filter_numbers`."""
        for name in SUMS:
            self.sums[name] += found[name]
        self.max_residual = max(self.max_residual, found["max_residual"])
        for name in MARGINS:
            if name in found:
                self.least[name] = min(self.least.get(name, math.inf), found[name])

    def summary(self) -> dict[str, float]:
        """Rates per robot-step, counts in robot-steps, mean correction in m/s, largest residual of an executed solution, and
        the least of each barrier before the steps (:data:`MARGINS`).
        """
        steps = max(self.sums["robot_steps"], 1.0)
        return {
            "intervention_rate": self.sums["interventions"] / steps,
            "mean_correction": self.sums["correction"] / steps,
            "fallback_rate": self.sums["fallbacks"] / steps,
            "homing_rate": self.sums["homing"] / steps,
            "infeasible": int(self.sums["infeasible"]),
            "inaccurate": int(self.sums["inaccurate"]),
            "outside": int(self.sums["outside"]),
            "max_residual": self.max_residual,
            **{name: value for name, value in self.least.items() if math.isfinite(value)},
        }

    def state_dict(self) -> dict:
        """All sums, for checkpoints."""
        return {"sums": dict(self.sums), "max_residual": self.max_residual, "least": dict(self.least)}

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.sums, self.least = dict(state["sums"]), dict(state["least"])
        self.max_residual = state["max_residual"]


def filter_numbers(
    tensordict: TensorDictBase, max_speed: float, alive: Tensor | None = None, n_blocks: int = 1
) -> dict[str, Tensor]:
    """What :meth:`FilterStatistics.add` takes of each block, ``(n_blocks,)`` float64: the device is not waited for.

    Args:
        tensordict: holds the filter's diagnostics, ``(*B, N)`` and ``(*B, N, 1)``, of any batch shape.
        max_speed: unit of the intervention threshold, m/s.
        alive: ``(*B, 1)`` bool, worlds that count; all if not given.
        n_blocks: equal blocks of worlds.
    """
    status, level = tensordict[keys.STATUS], tensordict[keys.LEVEL]
    correction, residual = tensordict[keys.CORRECTION].squeeze(-1), tensordict[keys.RESIDUAL].squeeze(-1)
    counts = torch.ones_like(status, dtype=torch.bool) if alive is None else alive.expand(status.shape)
    rows = (
        counts,
        counts & (correction > 1e-6 * max_speed),
        torch.where(counts, correction, 0.0),
        counts & (level > 0),
        counts & (status == QPStatus.INFEASIBLE),
        counts & (status == QPStatus.INACCURATE),
        counts & tensordict[keys.OUTSIDE],
        counts & (level == HOMING),
    )
    sums = (row.reshape(n_blocks, -1).sum(-1, dtype=torch.float64) for row in rows)
    found: dict[str, Tensor] = dict(zip(SUMS, sums, strict=True))
    solved = torch.where(counts & (status == QPStatus.SOLVED), residual, 0.0)
    found["max_residual"] = solved.reshape(n_blocks, -1).amax(-1).double()
    margins = {name: tensordict.get(key, None) for name, key in MARGINS.items()}
    for name, x in margins.items():
        if x is not None:
            found[name] = torch.where(counts, x.squeeze(-1), torch.inf).reshape(n_blocks, -1).amin(-1).double()
    return found
