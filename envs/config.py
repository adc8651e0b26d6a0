"""The world's parameters: one dataclass with a default, a unit and a range for every field, validated when it is built."""

import math
import warnings
from dataclasses import dataclass, field
from typing import Any

import torch

from envs.battery import break_even_radius
from envs.homing import HomingGeometry
from envs.inequalities import check_inequalities, least_clearance
from envs.layout import perimeter_docks, slot_ring

DENSITIES = ("uniform", "gaussian_mixture", "moving", "age")
MAX_AGENTS = 64


def check_range(name: str, value: Any, low: float, high: float, *, open_low: bool = False, hint: str = "") -> None:
    """Raise a ``ValueError`` naming the field, its value, the allowed range and the remedy unless ``low <= value <= high``."""
    inside = isinstance(value, int | float) and math.isfinite(value) and low <= value <= high
    if not inside or (open_low and value == low):
        bracket = "(" if open_low else "["
        raise ValueError(f"{name}={value} is out of range: allowed {bracket}{low}, {high}]. {hint}".rstrip())


def check_choice(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    """Raise a ``ValueError`` naming the field, its value and the allowed choices unless ``value`` is one of them."""
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is unknown: choose one of {', '.join(allowed)}.")


@dataclass
class SurveillanceConfig:
    """A world of battery-driven robots, charging stations and a density to watch over.

    Lists are in metres, one row per station/slot/density component; missing coordinates (a 2-D list in a 3-D world)
    are filled in as each field says. Raises ``ValueError`` naming value, range and remedy when a field is out of range.
    """

    n_agents: int = 3
    """Number of robots N, 1..64."""
    dimension: int = 2
    """Dimension d of positions and velocities: 2 (ground) or 3 (aerial)."""
    dt: float = 0.2
    """Length of one step, s, (0, 10]."""
    max_speed: float = 0.2
    """Speed limit (Euclidean norm), m/s, (0, 100]."""
    arena: list[Any] = field(default_factory=lambda: [[-1.0, 1.0], [-1.0, 1.0]])
    """[low, high] per axis, m; a missing third axis repeats the last row."""
    stations: list[Any] = field(default_factory=list)
    """Station centres, m; empty = one per robot, evenly spaced along the arena's walls. A missing third coordinate is the floor."""
    slots: Any = 1
    """Slots per station (int, 1..16; several stand on a ring of slot_radius) or the list of all slot positions, m."""
    slot_radius: float = 0.085
    """Distance of a station's slots from its centre when it has several, m, [0, 10]."""
    energy_min: float = 0.1
    """Lowest admissible energy E_min, energy units, [0, energy_max)."""
    energy_max: float = 1.0
    """Highest admissible energy E_max, energy units, (energy_min, 1e6]."""
    drain_rate: float = 0.06
    """Drain K_d at rest, energy/s, > 0. The default empties a full battery in 75 steps."""
    drain_per_speed: float = 0.0
    """Additional drain per speed, energy/m, >= 0 (0 = the paper's constant drain)."""
    drain_per_speed_squared: float = 0.0
    """Additional drain per squared speed, energy s/m^2, >= 0."""
    charge_rate: float = 0.36
    """Charging power K_c at full charging field and current 1, energy/s, > the drain at max_speed."""
    charge_radius_full: float = 0.12
    """Distance to a station up to which the charging field is 1, m, [0, charge_radius)."""
    charge_radius: float = 0.24
    """Distance to a station at which the charging field reaches 0, m, (0, 100]."""
    safety_distance: float = 0.12
    """Minimum distance Delta of two robots, m, (0, 10]."""
    horizon: int = 100
    """Steps until an episode is truncated; 0 = never."""
    density: str = "gaussian_mixture"
    """Family of the density: uniform | gaussian_mixture | moving | age."""
    density_centers: list[Any] = field(default_factory=lambda: [[-0.45, -0.35], [0.5, -0.15], [0.0, 0.55]])
    """Centres of the Gaussian components, m; a missing third coordinate is the middle of the arena."""
    density_sigma: float = 0.3
    """Standard deviation of every Gaussian component, m, (0, 100]."""
    density_per_world: bool = False
    """gaussian_mixture: draw as many centres as density_centers has uniformly at each reset instead of using them."""
    density_amplitude: float = 0.3
    """moving: radius of the circle on which a centre moves, m, [0, 100]."""
    density_period: float = 40.0
    """moving: time of one revolution, s, (0, 1e6]."""
    sensing_radius: float = 0.35
    """age: a point nearer than this to a robot is being looked at, m, (0, 100]."""
    age_limit: float = 20.0
    """age: time after which a point's importance stops growing, s, (0, 1e6]."""
    resolution: int = 0
    """Quadrature points per axis, 2..512; 0 = 20 in 2-D (RMS error of J below 1 %) and 10 in 3-D (1.5 %)."""
    on_violation: str = "terminate"
    """terminate: the first violation ends the episode. continue: every one counts, a drained robot stands still.
    (It then executes u = 0 whatever ("agents", "action") says.)"""
    reserve: str = "linear"
    """Reserve family rho: linear (drive home at homing_speed) | logarithmic (exponential approach; needs more reserve)."""
    homing_speed: float = 0.98
    """Speed v of driving home as a share of max_speed, (0, 0.9999]."""
    homing_clearance: float = 0.0
    """Distance Delta_G that two robots on their way home must keep, m, [0, 10]; 0 = the least that will do."""
    reassign_slots: bool = True
    """Exchange slots between robots after a transition where the new state stays certified."""
    reset_clearance: float = 0.0
    """Distance added to the certificate's Delta_G when a start state is drawn, m, [0, 10]."""
    reset_reserve: float = 0.1
    """Share of the battery's range that a drawn robot has above its reserve, [0, 0.99]."""
    observe_centroid: bool = False
    """Append the vector to the robot's Voronoi centroid to its observation (hands Lloyd's answer to the network: for ablation)."""
    dtype: str = "float32"
    """Floating point type of the world: float32 | float64."""

    def __post_init__(self) -> None:
        """Check every field and every combination that the world itself needs."""
        self._check_fields()
        self._check_layout()
        check_inequalities(self)

    # ---- derived values -------------------------------------------------------------------------------------------
    @property
    def torch_dtype(self) -> torch.dtype:
        """The torch dtype named by ``dtype``."""
        return torch.float32 if self.dtype == "float32" else torch.float64

    @property
    def bounds(self) -> list[list[float]]:
        """``[low, high]`` per axis, ``d`` rows, m."""
        rows = [[float(low), float(high)] for low, high in self.arena]
        return [*rows, rows[-1]][: self.dimension]

    @property
    def diameter(self) -> float:
        """Length of the arena's diagonal, m."""
        return math.dist([low for low, _ in self.bounds], [high for _, high in self.bounds])

    @property
    def length_scale(self) -> float:
        """Half the longest side of the arena, m: the unit of lengths in the observation."""
        return max(high - low for low, high in self.bounds) / 2

    @property
    def station_positions(self) -> list[list[float]]:
        """Station centres, M rows of d coordinates, m."""
        rows = self.stations or perimeter_docks(self.bounds, self.n_agents)
        return self._complete(rows, floor=True)

    @property
    def slot_positions(self) -> list[list[float]]:
        """All slots, S rows of d coordinates, m, station by station."""
        if not isinstance(self.slots, int):
            return self._complete(self.slots, floor=True)
        stations = self.station_positions
        if self.slots == 1:
            return stations
        return [slot for station in stations for slot in slot_ring(station, self.slots, self.slot_radius)]

    @property
    def density_center_positions(self) -> list[list[float]]:
        """Centres of the density's components, K rows of d coordinates, m."""
        return self._complete(self.density_centers, floor=False)

    @property
    def quadrature_resolution(self) -> int:
        """Quadrature points per axis."""
        return self.resolution or (20 if self.dimension == 2 else 10)

    @property
    def max_drain_rate(self) -> float:
        """Drain at ``max_speed``, energy/s: what the reserve counts with."""
        return (
            self.drain_rate + self.drain_per_speed * self.max_speed + self.drain_per_speed_squared * self.max_speed**2
        )

    @property
    def break_even_radius(self) -> float:
        """Distance ``R_be`` to a station at which charging equals the drain at full speed, m."""
        return break_even_radius(self.max_drain_rate / self.charge_rate, self.charge_radius_full, self.charge_radius)

    @property
    def homing(self) -> HomingGeometry:
        """Constants of driving home (docs/safety.md), derived from the fields."""
        offset = max(min(math.dist(slot, s) for s in self.station_positions) for slot in self.slot_positions)
        charge_radius = self.break_even_radius - offset
        speed = self.homing_speed * self.max_speed
        gain = self.homing_speed * self.max_speed / self.diameter
        linear = self.reserve == "linear"
        unit = torch.finfo(self.torch_dtype).eps / 2
        reach = max(abs(x) for row in self.bounds for x in row)
        steps_home = (
            math.ceil(self.diameter / (speed * self.dt)) if linear else math.ceil(-math.log(unit) / (gain * self.dt))
        )
        # the logarithmic reserve is steepest at its end, where a rounding of the position weighs most
        steepest = 1.0 if linear else max(1.0, self.diameter / max(charge_radius, 1e-9))
        energy_scale = self.energy_max + self.max_drain_rate * (self.diameter + reach * steepest) / speed
        eps_energy = max(1e-4 * (self.energy_max - self.energy_min), 4 * steps_home * unit * energy_scale)
        eps_distance = max(5e-3 * self.safety_distance, 8 * steps_home * unit * reach)
        return HomingGeometry(
            family=self.reserve,
            drain_rate=self.max_drain_rate,
            speed=speed,
            gain=gain,
            dt=self.dt,
            charge_radius=charge_radius,
            reserve_radius=charge_radius - speed * self.dt if linear else charge_radius * (1 - gain * self.dt),
            clearance=self.homing_clearance or least_clearance(self, eps_distance),
            energy_min=self.energy_min,
            energy_max=self.energy_max,
            eps_energy=eps_energy,
            eps_distance=eps_distance,
        )

    # ---- checks ---------------------------------------------------------------------------------------------------
    def _check_fields(self) -> None:
        for name in ("n_agents", "dimension", "horizon", "resolution"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise ValueError(f"env.{name}={value!r} must be a whole number.")
        check_range("env.n_agents", self.n_agents, 1, MAX_AGENTS)
        if self.dimension not in (2, 3):
            raise ValueError(f"env.dimension={self.dimension} is not supported: choose 2 (ground) or 3 (aerial).")
        check_range("env.dt", self.dt, 0, 10, open_low=True)
        check_range("env.max_speed", self.max_speed, 0, 100, open_low=True)
        check_range("env.slot_radius", self.slot_radius, 0, 10)
        check_range("env.energy_max", self.energy_max, 0, 1e6, open_low=True)
        check_range("env.energy_min", self.energy_min, 0, self.energy_max, hint="It must be below env.energy_max.")
        if self.energy_min >= self.energy_max:
            raise ValueError(f"env.energy_min={self.energy_min} must be below env.energy_max={self.energy_max}.")
        check_range("env.drain_rate", self.drain_rate, 0, 1e6, open_low=True)
        check_range("env.drain_per_speed", self.drain_per_speed, 0, 1e6)
        check_range("env.drain_per_speed_squared", self.drain_per_speed_squared, 0, 1e6)
        check_range("env.charge_rate", self.charge_rate, 0, 1e6, open_low=True)
        check_range("env.charge_radius", self.charge_radius, 0, 100, open_low=True)
        check_range("env.charge_radius_full", self.charge_radius_full, 0, self.charge_radius)
        if self.charge_radius_full >= self.charge_radius:
            raise ValueError(
                f"env.charge_radius_full={self.charge_radius_full} must be below env.charge_radius={self.charge_radius}."
            )
        check_range("env.safety_distance", self.safety_distance, 0, 10, open_low=True)
        check_range("env.horizon", self.horizon, 0, 10**9, hint="0 means no time limit.")
        check_choice("env.density", self.density, DENSITIES)
        check_range("env.density_sigma", self.density_sigma, 0, 100, open_low=True)
        check_range("env.density_amplitude", self.density_amplitude, 0, 100)
        check_range("env.density_period", self.density_period, 0, 1e6, open_low=True)
        check_range("env.sensing_radius", self.sensing_radius, 0, 100, open_low=True)
        check_range("env.age_limit", self.age_limit, 0, 1e6, open_low=True)
        if self.resolution != 0:
            check_range("env.resolution", self.resolution, 2, 512, hint="0 chooses it by the dimension.")
        check_choice("env.on_violation", self.on_violation, ("terminate", "continue"))
        check_choice("env.reserve", self.reserve, ("linear", "logarithmic"))
        check_range("env.homing_speed", self.homing_speed, 0, 0.9999, open_low=True)
        check_range("env.homing_clearance", self.homing_clearance, 0, 10, hint="0 chooses the least that will do.")
        check_range("env.reset_clearance", self.reset_clearance, 0, 10)
        check_range("env.reset_reserve", self.reset_reserve, 0, 0.99)
        check_choice("env.dtype", self.dtype, ("float32", "float64"))

    def _check_layout(self) -> None:
        for name in ("arena", "stations", "slots", "density_centers"):
            setattr(self, name, _listed(getattr(self, name)))
        if not _is_table(self.arena, (2,)) or len(self.arena) not in (2, 3):
            raise ValueError(f"env.arena={self.arena} must be 2 or 3 rows [low, high] in metres.")
        if any(not low < high for low, high in self.bounds):
            raise ValueError(f"env.arena={self.arena} is empty: every row needs low < high.")
        is_count = isinstance(self.slots, int) and not isinstance(self.slots, bool)
        if is_count:
            check_range("env.slots", self.slots, 1, 16, hint="Or give the list of slot positions.")
        for name in ("stations", "density_centers") + (() if is_count else ("slots",)):
            rows = getattr(self, name)
            if not _is_table(rows, (2, self.dimension)):
                raise ValueError(
                    f"env.{name}={rows} must be a list of positions [x, y{', z' * (self.dimension - 2)}] in metres."
                )
        if not self.density_centers:
            raise ValueError("env.density_centers=[] is empty: give at least one centre.")
        if self.density == "moving" or (self.density == "gaussian_mixture" and not self.density_per_world):
            centers = zip(self.density_centers, self.density_center_positions, strict=True)
            if outside := [row for row, center in centers if not self._inside(center)]:
                warnings.warn(
                    f"env.density_centers={self.density_centers}: {outside} lie outside env.arena={self.arena}, so what is worth "
                    "watching is at its edge. Give centres inside the arena, or density=uniform.",
                    stacklevel=2,
                )

    def _inside(self, position: list[float]) -> bool:
        return all(low <= x <= high for x, (low, high) in zip(position, self.bounds, strict=True))

    def _complete(self, rows: list[list[float]], *, floor: bool) -> list[list[float]]:
        fill = [low if floor else (low + high) / 2 for low, high in self.bounds]
        return [[float(x) for x in row] + fill[len(row) :] for row in rows]


def _listed(rows: Any) -> Any:
    """Rows given as tuples, as lists."""
    return [_listed(row) for row in rows] if isinstance(rows, list | tuple) else rows


def _is_table(rows: Any, widths: tuple[int, ...]) -> bool:
    """Whether ``rows`` is a list of rows of finite numbers, each as long as one of ``widths``."""
    return isinstance(rows, list) and all(
        isinstance(row, list)
        and len(row) in widths
        and all(isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) for x in row)
        for row in rows
    )
