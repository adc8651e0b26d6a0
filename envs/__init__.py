"""Worlds: physics, batteries, coverage, homing geometry and the batched TorchRL environment."""

from envs.config import SurveillanceConfig
from envs.surveillance import SurveillanceEnv

__all__ = ["SurveillanceConfig", "SurveillanceEnv"]
