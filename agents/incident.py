"""A violation behind the certified filter: the state that caused it, kept so that it can be replayed as a test.

The filter's promise is that there is none, so training and evaluation stop at the first one. The dump holds the world,
the filter, the state and the nominal action in full precision; :func:`replay` computes the step again.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

STATE = {"position": keys.POSITION, "energy": keys.ENERGY, "slot": keys.SLOT, "nominal_action": keys.NOMINAL_ACTION}
EXECUTED = {"action": keys.ACTION, "charge_current": keys.CHARGE_CURRENT, "status": keys.STATUS, "level": keys.LEVEL}


class ViolationError(RuntimeError):
    """A robot violated a constraint behind the certified filter; the message names the dump."""


@dataclass
class Incident:
    """One step of one world that ended in a violation."""

    world: SurveillanceConfig
    safety: SafetyConfig
    state: TensorDict
    """State and nominal action before the step, ``(1,)``."""
    kinds: list[str]
    """Kinds of violation."""


def check_violations(
    tensordict: TensorDictBase,
    alive: Tensor | None = None,
    *,
    world: SurveillanceConfig,
    safety: SafetyConfig,
    folder: Path,
) -> None:
    """Stop a certified run at its first violation, or state outside the certified set, after writing ``violation.json``.

    Args:
        tensordict: transitions of any batch shape.
        alive: ``(*B, 1)`` bool, worlds that count; all if not given.
        world: the world.
        safety: the filter; any other mode is let pass.
        folder: where the dump goes.

    Raises:
        ViolationError: naming the dump.
    """
    if safety.mode != "certified":
        return
    flags = broken_promises(tensordict, alive)
    if not flags.any():
        return
    first = tuple(flags.flatten(-2).any(dim=-1).nonzero()[0].tolist())
    row, flags = tensordict[first], flags[first]
    path = save_incident(folder / "violation.json", row, world, safety)
    kinds = [kind for k, kind in enumerate((*keys.VIOLATION_KINDS, "left the certified set")) if flags[:, k].any()]
    raise ViolationError(
        f"{', '.join(kinds)} behind the certified filter, which must not happen: please report it. The state that caused it "
        f"is in {path}; agents.incident.replay computes the step again, a copy in tests/violations/ is tested from then on."
    )


def broken_promises(tensordict: TensorDictBase, alive: Tensor | None = None) -> Tensor:
    """Violations by kind and states outside the certified set, ``(*B, N, 5)``, of the arguments of :func:`check_violations`."""
    flags = [tensordict["next"][(*keys.VIOLATION, kind)].squeeze(-1) for kind in keys.VIOLATION_KINDS]
    flags = torch.stack([*flags, tensordict[keys.OUTSIDE]], -1)
    return flags if alive is None else flags & alive.unsqueeze(-1)


def save_incident(path: Path, row: TensorDictBase, world: SurveillanceConfig, safety: SafetyConfig) -> Path:
    """Write one transition ``()`` as JSON, its numbers in full precision; NaN and infinities as JSON extensions."""
    kinds = [kind for kind in keys.VIOLATION_KINDS if row["next"][(*keys.VIOLATION, kind)].any()]
    content = {
        "kinds": kinds,
        "env": asdict(world),
        "safety": asdict(safety),
        "state": {name: row[key].tolist() for name, key in STATE.items()},
        "executed": {name: row[key].tolist() for name, key in EXECUTED.items()},
        "next": {name: row["next"][STATE[name]].tolist() for name in ("position", "energy", "slot")},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def load_incident(path: Path) -> Incident:
    """Read what :func:`save_incident` wrote.

    Raises:
        ValueError: if the file is not such a dump.
    """
    try:
        content = json.loads(path.read_text())
        world, safety = SurveillanceConfig(**content["env"]), SafetyConfig(**content["safety"])
        state = {
            key: torch.tensor([content["state"][name]], dtype=torch.int64 if name == "slot" else world.torch_dtype)
            for name, key in STATE.items()
        }
        return Incident(world, safety, TensorDict(state, [1]), content["kinds"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not the dump of a violation ({error!r}).") from error


def replay(incident: Incident) -> TensorDictBase:
    """The step of an incident, filtered and executed anew: the transition ``(1,)`` with its violation flags."""
    env = SurveillanceEnv(incident.world, 1)
    state = incident.state
    td = env.set_state(state[keys.POSITION], state[keys.ENERGY], state[keys.SLOT])
    td[keys.NOMINAL_ACTION] = state[keys.NOMINAL_ACTION]
    return env.step(SafetyFilter(incident.safety, incident.world)(td))
