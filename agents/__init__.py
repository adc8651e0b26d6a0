"""The learner, its networks and the controllers that it is compared with."""

from agents.config import AgentConfig
from agents.controllers import make_controller

__all__ = ["AgentConfig", "make_controller"]
