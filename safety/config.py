"""Parameters of the safety filter, validated when they are built."""

from dataclasses import dataclass
from typing import NamedTuple

from envs.config import SurveillanceConfig, check_choice, check_range
from envs.inequalities import least_clearance


class Gains(NamedTuple):
    """Class-K gains of the barriers, 1/s."""

    energy: float
    """``alpha_c`` of the survivability barrier."""
    overcharge: float
    """``alpha_o``."""
    collision: float
    """``alpha_s``."""
    certificate: float
    """``alpha_g`` of the homing certificate."""


@dataclass
class SafetyConfig:
    """Which filter stands between the nominal action and the world.

    The default is the certified filter: no violation of any kind for any nominal action (docs/safety.md). The others
    are the literature's, for comparison, and do violate: ``mode=paper composition=min split=full sampled_data=false``
    is the literal reading of the paper.
    """

    mode: str = "certified"
    """certified: rows centred on the homing certificate, and the shield. paper: control barrier function quadratic
    program of the literature. dalal: learned linear constraint models, correction in closed form (safety/dalal.py).
    none: speed limit only. composition, split, sampled_data, gains and solver are ignored by dalal and none."""
    composition: str = "stacked"
    """stacked: one row per barrier. min: one row per robot, of its smallest barrier (the paper's h_i)."""
    split: str = "auto"
    """auto: anchor for certified, half for paper. anchor: a pair's rows are centred on an action that is admissible for
    both. half: each robot of a pair takes half of the row. full: all of it, the other taken as static. joint: one
    quadratic program over all robots."""
    sampled_data: bool = True
    """Take the survivability row on the exact one-step map with rounding margins (docs/safety.md, section 3) instead of the
    literature's continuous-time row, which lets a robot reach its charger a step too late. Needs composition=stacked."""
    alpha_c: float | None = None
    """Class-K gain of the survivability barrier, 1/s, (0, 1/dt]; null = 0.2/dt."""
    alpha_o: float | None = None
    """Class-K gain of the overcharge barrier, 1/s, (0, 1/dt]; null = 0.5/dt."""
    alpha_s: float | None = None
    """Class-K gain of the collision barrier, 1/s, (0, 1/dt], with split=full (0, 0.5/dt]; null = the largest."""
    alpha_g: float | None = None
    """Class-K gain of the homing certificate far from its limit, 1/s, (0, 1/dt]; null = 1/dt. certified only."""
    solver: str = "auto"
    """auto: exact for one robot's problem, active_set for the joint one. exact | active_set | pdipm | qpth choose."""
    in_loss: bool = False
    """Put the filter into the policy that the loss differentiates (gradient through the QP), and into its target."""
    dalal_margin: float = 3.0
    """dalal: distance that the models keep from every limit, [0, 100]: the energy drained, and the gap closed by one
    robot, in this many steps. 0 is the bare limit."""
    dalal_steps: int = 3000
    """dalal: optimiser steps of the fit before training, 1..1000000."""
    dalal_drift: bool = True
    """dalal: let the models have a part that does not depend on the action. false: the source's model."""

    def __post_init__(self) -> None:
        """Check every field and their combination."""
        check_choice("safety.mode", self.mode, ("certified", "paper", "dalal", "none"))
        check_choice("safety.composition", self.composition, ("stacked", "min"))
        check_choice("safety.split", self.split, ("auto", "anchor", "half", "full", "joint"))
        check_choice("safety.solver", self.solver, ("auto", "exact", "active_set", "pdipm", "qpth"))
        check_range("safety.dalal_margin", self.dalal_margin, 0, 100)
        check_range("safety.dalal_steps", self.dalal_steps, 1, 10**6)
        certified = self.mode == "certified"
        if certified and (self.composition != "stacked" or not self.sampled_data):
            raise ValueError(
                f"safety.mode=certified takes all rows on the exact one-step map: safety.composition={self.composition} "
                f"safety.sampled_data={self.sampled_data} belong to safety.mode=paper."
            )
        allowed = ("auto", "anchor", "half") if certified else ("auto", "half", "full", "joint")
        if self.split not in allowed and self.mode in ("certified", "paper"):
            raise ValueError(
                f"safety.split={self.split} does not fit safety.mode={self.mode}: choose {', '.join(allowed)}."
            )
        if self.composition == "min" and self.sampled_data:
            raise ValueError(
                "safety.sampled_data=true needs safety.composition=stacked (the composite's smallest barrier changes within a "
                "step): set safety.sampled_data=false."
            )
        if self.split == "joint" and self.solver == "exact":
            raise ValueError(
                "safety.solver='exact' solves one robot's problem (2 or 3 variables), safety.split='joint' has all robots': "
                "choose safety.solver=active_set or safety.split=half."
            )

    @property
    def may_fix_sizes(self) -> bool:
        """Whether the filter can work at fixed sizes."""
        return self.mode in ("dalal", "none") or (self.split != "joint" and self.solver in ("auto", "exact"))

    def check_sizes(self, *, fixed_sizes: bool) -> None:
        """Raise a ``ValueError`` if the filter cannot work at fixed sizes and is asked to."""
        if fixed_sizes and not self.may_fix_sizes:
            raise ValueError(
                f"fixed_sizes=true needs the exact solver and a problem per robot: safety.split={self.split} "
                f"safety.solver={self.solver} iterate until all problems are solved. Set safety.split=auto "
                "safety.solver=auto, or fixed_sizes=false cuda_graphs=false."
            )

    def gains(self, world: SurveillanceConfig) -> Gains:
        """The gains in this world, 1/s.

        Raises:
            ValueError: if a gain is outside ``(0, 1/dt]`` (``alpha_s`` with ``split=full``: ``(0, 0.5/dt]``), where a sampled
                barrier may jump below zero, or does not fit the world's certificate (docs/safety.md, inequalities 1, 4 and 6).
        """
        defaults = {"alpha_c": 0.2, "alpha_o": 0.5, "alpha_s": 0.5 if self.split == "full" else 1.0, "alpha_g": 1.0}
        values = []
        for name, share in defaults.items():
            value = getattr(self, name)
            gain = share / world.dt if value is None else value
            # "The other robot stands still" counts the approach of both for one: half the gain is the sharp bound.
            most = 0.5 if name == "alpha_s" and self.split == "full" else 1.0
            hint = f"alpha dt must not exceed {most:g} (env.dt={world.dt}); null chooses {share / world.dt:g}."
            check_range(f"safety.{name}", gain, 0, most / world.dt, open_low=True, hint=hint)
            values.append(gain)
        gains = Gains(*values)
        if self.mode in ("certified", "paper"):
            self._check_throttle(world, gains)
        if self.mode == "certified":
            self._check_clearance(world, gains)
        return gains

    @staticmethod
    def _check_throttle(world: SurveillanceConfig, gains: Gains) -> None:
        """The overcharge row must not throttle charging below the drain at full speed while a robot needs it."""
        spread = world.max_drain_rate - world.drain_rate
        least = 3 * world.homing.eps_energy + world.dt * world.max_drain_rate
        span = world.energy_max - world.energy_min
        if spread and span <= least + world.dt * spread * (1 + 1 / (gains.overcharge * world.dt)):
            needed = spread / max(span - least - world.dt * spread, 1e-30)
            remedy = (
                f"Raise it above {needed:.4g}" if needed < 1 / world.dt else "Enlarge the battery or shorten env.dt"
            )
            raise ValueError(
                f"safety.alpha_o={gains.overcharge:g} throttles charging below the drain at full speed: E_max - E_min > 3 eps_E + "
                f"P dt + (P - K_d)(dt + 1/alpha_o) fails with {span:.4g} > "
                f"{least + world.dt * spread + spread / gains.overcharge:.4g}. {remedy}."
            )

    @staticmethod
    def _check_clearance(world: SurveillanceConfig, gains: Gains) -> None:
        """Two homing robots must satisfy their collision row (docs/safety.md, lemma 5)."""
        homing = world.homing
        needed = least_clearance(world, homing.eps_distance, gains.collision * world.dt)
        if homing.clearance < needed * (1 - 1e-9):
            raise ValueError(
                f"safety.alpha_s={gains.collision:g}: Delta_G^2 >= (Delta + eps)^2 + (2 max_speed / alpha_s)^2 fails with "
                f"Delta_G = {homing.clearance:.4g} < {needed:.4g} m. Set safety.alpha_s=null ({1 / world.dt:g}) or "
                f"env.homing_clearance={needed * 1.0001:.4g}."
            )
