"""Construction of the training pipeline: environment, collector and replay buffer."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform

from agents.adversary_reward import AdversaryReward
from envs import SurveillanceEnv, keys

STORED = (
    *(keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT, keys.NOMINAL_ACTION, keys.ACTION, keys.CHARGE_CURRENT),
    *(("next", *key) for key in (keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT)),
    *(("next", *key) for key in (keys.REWARD, keys.DONE, keys.TERMINATED)),
    ("next", "done"),
)
STEPS = "steps_to_next_obs"  # TorchRL's name for the length of an n-step transition


def pick_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one.

    Raises:
        ValueError: if CUDA is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: PyTorch sees no CUDA device here. Use device=cpu or device=auto.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def make_collector(
    env: SurveillanceEnv, policy: TensorDictModuleBase, frames_per_batch: int, total_frames: int
) -> Collector:
    """TorchRL collector of ``(num_envs, T)`` batches; warm-up uses the policy, never the environment's random action."""
    return Collector(
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=total_frames,
        device=env.device,
        split_trajs=False,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,  # the noise reads the world's own step count
    )


def make_buffer(capacity: int, batch_size: int, device: torch.device, seed: int) -> TensorDictReplayBuffer:
    """Uniform replay with its own generator. It holds the executed action and every key that the filter reads."""
    generator = torch.Generator().manual_seed(seed)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, device=device), batch_size=batch_size, generator=generator
    )


def to_transitions(
    batch: TensorDictBase, violation_penalty: float = 0.0, adversary: AdversaryReward | None = None
) -> TensorDictBase:
    """What is stored of a collected batch.

    Args:
        batch: ``(num_envs, T)``.
        violation_penalty: subtracted from a robot's reward per violation of its own (a baseline; 0 = off).
        adversary: takes the place of the environment's reward.

    Returns:
        ``(num_envs, T)``.
    """
    transitions = batch.select(*STORED)
    if adversary is not None:
        flat = transitions["next"].reshape(-1)
        transitions["next"][keys.REWARD] = adversary(flat).reshape(transitions["next"][keys.REWARD].shape)
    if violation_penalty:
        count = sum(batch["next"][(*keys.VIOLATION, kind)].float() for kind in keys.VIOLATION_KINDS)
        transitions["next"][keys.REWARD] = transitions["next"][keys.REWARD] - violation_penalty * count
    return transitions


class MultiStep:
    """Turns collected steps into transitions over ``n_steps`` steps, fewer where an episode ends on the way.

    The reward becomes the discounted sum, "next" (flags included) the last step's; "steps_to_next_obs" tells the target how
    far that is. The newest ``n_steps`` steps of every world wait for the following call.

    Args:
        n_steps: 1 passes the transitions through as they are.
        gamma: discount per step.
    """

    def __init__(self, n_steps: int, gamma: float) -> None:
        self.transform = MultiStepTransform(n_steps, gamma, reward_keys=[keys.REWARD]) if n_steps > 1 else None

    def __call__(self, transitions: TensorDictBase) -> TensorDictBase:
        """``(num_envs, T) -> (num_envs * T,)``, less than that at the start."""
        if self.transform is None:
            return transitions.reshape(-1)
        merged = self.transform.inv(transitions)
        if merged is None:
            return transitions.reshape(-1)[:0]
        steps = merged[STEPS][..., None, None].expand_as(merged["next"][keys.REWARD])  # as the target wants it
        return merged.select(*STORED).set(STEPS, steps).reshape(-1)
