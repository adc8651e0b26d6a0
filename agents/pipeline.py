"""The training pipeline up to the replay buffer: collector, what is stored of a batch, n-step transitions."""

import contextlib
import ctypes
import os
from collections.abc import Generator
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import set_exploration_type

from agents.adversary_reward import AdversaryReward
from agents.replay import flat
from envs import SurveillanceEnv, keys

STORED = (
    *(keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT, keys.NOMINAL_ACTION, keys.ACTION, keys.CHARGE_CURRENT),
    *(("next", *key) for key in (keys.OBSERVATION, keys.POSITION, keys.ENERGY, keys.SLOT)),
    *(("next", *key) for key in (keys.REWARD, keys.DONE, keys.TERMINATED)),
    ("next", "done"),
)
COLLECTOR_OPTIONS = {
    "split_trajs": False,
    "track_traj_ids": False,
    "trust_policy": True,
    "auto_register_policy_transforms": False,  # the noise reads the world's own step count
    "return_same_td": True,  # no copy
    "no_cuda_sync": True,  # one device, one stream
}
STEPS = "steps_to_next_obs"  # TorchRL's name for the length of an n-step transition


def pick_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one.

    Raises:
        ValueError: if CUDA is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: PyTorch sees no CUDA device here. Use device=cpu or device=auto.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def keep_freed_memory() -> None:
    """Keep the memory of freed tensors for the next ones instead of giving it back to the system, where glibc is in use.

    Otherwise temporary tensors of more than 128 kB to 32 MB are mapped anew, and zeroed page by page, each time.
    """
    trim_threshold, mmap_threshold = -1, -3  # glibc's numbers
    with contextlib.suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(mmap_threshold, 32 << 20)
        libc.mallopt(trim_threshold, 2**31 - 1)


def use_threads(threads: int, *, deterministic: bool = False) -> None:
    """Compute on this many CPU threads; 0 leaves PyTorch's choice.

    Args:
        threads: number of CPU threads.
        deterministic: refuse operations that may differ between runs.
    """
    keep_freed_memory()
    if threads:
        torch.set_num_threads(threads)
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it
        torch.backends.cudnn.benchmark = False
    torch.use_deterministic_algorithms(deterministic)


class InferenceCollector(Collector):
    """TorchRL's collector, in :meth:`SurveillanceEnv.without_gradients`; batches of one step are not copied together."""

    def rollout(self) -> TensorDictBase:
        """What TorchRL's does with :data:`COLLECTOR_OPTIONS`."""
        steps = []
        with self.env.without_gradients(), set_exploration_type(self.exploration_type):
            for _ in range(self.frames_per_batch):
                step, self._carrier = self.env.step_and_maybe_reset(self._wrapped_policy(self._carrier))
                steps.append(step)
            return cast(TensorDictBase, steps[0].unsqueeze(-1) if len(steps) == 1 else torch.stack(steps, dim=-1))


def collect(
    env: SurveillanceEnv, policy: TensorDictModuleBase, frames_per_batch: int, frames: int, *, resumed: bool = False
) -> Generator[TensorDictBase, None, None]:
    """Batches ``(num_envs, T)`` of TorchRL's collector; warm-up uses the policy, never the environment's random action.

    Where nothing is compiled they are inference tensors: whoever differentiates what comes from a batch itself, and not from
    rows that were stored or cloned, is told so by PyTorch.

    Args:
        env: the worlds, closed at the end.
        policy: noise, then filter.
        frames_per_batch: world-steps of a batch.
        frames: world-steps in all.
        resumed: the policy's noise goes on from a checkpoint.
    """
    if not frames:  # a run that was stopped after its last batch
        return
    noise_state = policy.state_dict()
    collector = InferenceCollector(
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=frames,
        device=env.device,
        **COLLECTOR_OPTIONS,
    )
    if resumed:  # a new collector tries its policy once, which draws noise; the first one's trial is part of the stream
        policy.load_state_dict(noise_state)
    try:
        yield from collector
    finally:
        collector.shutdown()


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

    The reward becomes the discounted sum, "next" with its flags the last step's; "steps_to_next_obs" tells the target how
    far that is. The newest ``n_steps - 1`` steps of every world wait for the following call.

    Args:
        n_steps: 1 passes the transitions through as they are.
        gamma: discount per step.
        n_blocks: equal blocks of worlds whose waiting steps are saved apart.
    """

    def __init__(self, n_steps: int, gamma: float, n_blocks: int = 1) -> None:
        self.n_steps, self.gamma = n_steps, gamma
        self.waiting: dict[tuple[str, ...], Tensor] = {}
        """By key, ``(num_envs, <= n_steps - 1, ...)``: of all blocks, one after the other."""
        self.blocks = [WaitingSteps(self, k) for k in range(n_blocks)]

    def __call__(self, transitions: TensorDictBase) -> TensorDictBase:
        """``(num_envs, T) -> (num_envs * T,)``, less than that at the start."""
        if self.n_steps == 1:
            return transitions.reshape(-1)
        if restored := [block.restored for block in self.blocks if block.restored is not None]:
            self.waiting = flat(cast(TensorDictBase, torch.cat(restored)).to(transitions.device))  # pyright: ignore[reportArgumentType]
            for block in self.blocks:
                block.restored = None
        window = {
            key: torch.cat([self.waiting[key], new], dim=1) if self.waiting else new
            for key, new in flat(transitions).items()
        }
        reward, done = window["next", *keys.REWARD], window["next", "done"].squeeze(-1)
        worlds, steps = done.shape
        self.waiting = {key: rows[:, max(0, steps - self.n_steps + 1) :] for key, rows in window.items()}
        length = steps - self.n_steps + 1
        if length <= 0:
            return transitions.reshape(-1)[:0]
        total, goes_on = reward[:, :length], ~done[:, :length]
        ahead = torch.zeros_like(goes_on, dtype=torch.int64)  # of the last step of each transition
        for k in range(1, self.n_steps):
            later = slice(k, k + length)
            total = total + torch.where(goes_on[..., None, None], self.gamma**k * reward[:, later], 0.0)
            ahead = ahead + goes_on
            goes_on = goes_on & ~done[:, later]
        row = torch.arange(worlds, device=done.device).unsqueeze(-1) * steps
        last = (row + torch.arange(length, device=done.device) + ahead).flatten()
        found = {
            key: rows.flatten(0, 1).index_select(0, last) if key[0] == "next" else rows[:, :length].flatten(0, 1)
            for key, rows in window.items()
        }
        taken = (ahead + 1).to(total.dtype)[..., None, None].expand_as(total)
        found |= {("next", *keys.REWARD): total.flatten(0, 1), (STEPS,): taken.flatten(0, 1)}
        return TensorDict(found, [worlds * length], transitions.device)


class WaitingSteps:
    """The waiting steps of a block of worlds, for checkpoints.

    Args:
        multi_step: what they wait for.
        k: which block.
    """

    def __init__(self, multi_step: MultiStep, k: int) -> None:
        self.multi_step, self.k = multi_step, k
        self.restored: TensorDictBase | None = None
        """From a checkpoint, until they are needed."""

    def state_dict(self) -> dict:
        """The steps that wait."""
        waiting, others = self.restored, self.multi_step
        if waiting is None and others.waiting:
            shape = others.waiting["next", "done"].shape[:2]
            waiting = TensorDict(others.waiting, shape).chunk(len(others.blocks))[self.k].clone()
        return {"waiting": None} if waiting is None else {"waiting": waiting.to_dict(), "shape": list(waiting.shape)}

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        waiting = state["waiting"]
        self.restored = None if waiting is None else TensorDict(waiting, state["shape"])
