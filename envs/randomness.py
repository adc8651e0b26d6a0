"""States of random generators, which differ between kinds of devices."""

import hashlib

import torch
from torch import Tensor


def restore_generator(generator: torch.Generator, state: Tensor) -> None:
    """Go on from a state; one of another kind of device (a GPU's, on a CPU) seeds the generator instead, to other numbers.

    Args:
        generator: on any device.
        state: what ``get_state`` returned, perhaps of a generator elsewhere.
    """
    state = state.cpu()
    if state.shape == generator.get_state().shape:
        generator.set_state(state)
    else:
        digest = hashlib.sha256(bytes(state.tolist())).digest()
        generator.manual_seed(int.from_bytes(digest[:7], "big"))
