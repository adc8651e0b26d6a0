"""TensorDict keys shared by the environment, the filter, the learner and the controllers: one place, no strings elsewhere.

Not here: TorchRL's own names ("next", "done", "terminated", "truncated", "_reset"), the names by which a world keeps its state
(:data:`envs.surveillance.STATE`), and keys of the learner alone, constants of :mod:`agents.networks` and :mod:`agents.pipeline`.
"""

AGENTS = "agents"
OBSERVATION = (AGENTS, "observation")
POSITION = (AGENTS, "position")
ENERGY = (AGENTS, "energy")
SLOT = (AGENTS, "slot")
NOMINAL_ACTION = (AGENTS, "nominal_action")
ACTION = (AGENTS, "action")
CHARGE_CURRENT = (AGENTS, "charge_current")
REWARD = (AGENTS, "reward")
DONE = (AGENTS, "done")
TERMINATED = (AGENTS, "terminated")
VIOLATION = (AGENTS, "violation")
VIOLATION_KINDS = ("depleted", "stranded", "overcharged", "collision")

COVERAGE_COST = "coverage_cost"
DENSITY = "density"
STEP_COUNT = "step_count"

FILTER = "filter"
CORRECTION = (FILTER, "correction")
STATUS = (FILTER, "status")
LEVEL = (FILTER, "level")
RESIDUAL = (FILTER, "residual")
BARRIER_ENERGY = (FILTER, "h_c")
BARRIER_OVERCHARGE = (FILTER, "h_o")
BARRIER_COLLISION = (FILTER, "h_s")
BARRIER_CERTIFICATE = (FILTER, "h_g")
OUTSIDE = (FILTER, "outside")
