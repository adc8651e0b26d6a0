"""Parameters of the safety filter, validated when they are built."""

from dataclasses import dataclass

from envs.config import SurveillanceConfig, check_choice, check_range


@dataclass
class SafetyConfig:
    """Which filter stands between the nominal action and the world.

    The default is the paper's filter in its strongest variant (all rows stacked, collision responsibility shared by
    halves, survivability row on the exact one-step map); ``composition=min split=full sampled_data=false`` is the
    literal reading of the paper. None of these is free of violations for several robots: see README, "Violations".
    """

    mode: str = "paper"
    """paper: control barrier function quadratic program. none: speed limit only."""
    composition: str = "stacked"
    """stacked: one row per barrier. min: one row per robot, of its smallest barrier (the paper's h_i)."""
    split: str = "half"
    """half: each robot of a pair takes half of the collision row. full: all of it, the other taken as static.
    joint: one quadratic program over all robots."""
    sampled_data: bool = True
    """Take the survivability row on the exact one-step map with rounding margins (SAFETY section 3) instead of the
    literature's continuous-time row, which lets a robot reach its charger a step too late. Needs composition=stacked."""
    alpha_c: float | None = None
    """Class-K gain of the survivability barrier, 1/s, (0, 1/dt]; null = 0.2/dt."""
    alpha_o: float | None = None
    """Class-K gain of the overcharge barrier, 1/s, (0, 1/dt]; null = 0.5/dt."""
    alpha_s: float | None = None
    """Class-K gain of the collision barrier, 1/s, (0, 1/dt]; null = 1/dt (0.5/dt with split=full)."""
    solver: str = "auto"
    """auto: exact for one robot's problem, qpth for the joint one. exact | qpth choose."""
    in_loss: bool = False
    """Put the filter into the policy that the loss differentiates (gradient through the QP), and into its target."""

    def __post_init__(self) -> None:
        """Check every field and their combination."""
        if self.mode == "certified":
            raise ValueError(
                "safety.mode='certified' is not available yet: choose paper or none. "
                "safety=stacked (the default) is the strongest filter there is today."
            )
        check_choice("safety.mode", self.mode, ("paper", "none"))
        check_choice("safety.composition", self.composition, ("stacked", "min"))
        check_choice("safety.split", self.split, ("half", "full", "joint"))
        check_choice("safety.solver", self.solver, ("auto", "exact", "qpth"))
        if self.composition == "min" and self.sampled_data:
            raise ValueError(
                "safety.sampled_data=true needs safety.composition=stacked (the composite's smallest barrier changes within a "
                "step): set safety.sampled_data=false."
            )
        if self.split == "joint" and self.solver == "exact":
            raise ValueError(
                "safety.solver='exact' solves one robot's problem (2 or 3 variables), safety.split='joint' has all robots': "
                "choose safety.solver=qpth or safety.split=half."
            )

    def gains(self, world: SurveillanceConfig) -> tuple[float, float, float]:
        """The gains ``(alpha_c, alpha_o, alpha_s)`` in this world, 1/s.

        Raises:
            ValueError: if a gain is outside ``(0, 1/dt]``, where a sampled barrier may jump below zero.
        """
        defaults = {"alpha_c": 0.2, "alpha_o": 0.5, "alpha_s": 0.5 if self.split == "full" else 1.0}
        gains = []
        for name, share in defaults.items():
            value = getattr(self, name)
            gain = share / world.dt if value is None else value
            # "The other robot stands still" counts the approach of both for one: half the gain is the sharp bound.
            most = 0.5 if name == "alpha_s" and self.split == "full" else 1.0
            hint = f"alpha dt must not exceed {most:g} (env.dt={world.dt}); null chooses {share / world.dt:g}."
            check_range(f"safety.{name}", gain, 0, most / world.dt, open_low=True, hint=hint)
            gains.append(gain)
        spread = world.max_drain_rate - world.drain_rate
        needed = 3 * world.homing.eps_energy + world.dt * (
            world.max_drain_rate + spread * (1 + 1 / (gains[1] * world.dt))
        )
        if self.mode != "none" and spread and world.energy_max - world.energy_min <= needed:
            raise ValueError(
                f"safety.alpha_o={gains[1]:g} throttles charging below the drain at full speed: env.energy_max - env.energy_min = "
                f"{world.energy_max - world.energy_min:g} must exceed {needed:.4g}. Raise safety.alpha_o."
            )
        return tuple(gains)
