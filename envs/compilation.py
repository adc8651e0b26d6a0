"""Optional torch.compile of pure tensor functions: same results to rounding, and never a reason to fail."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def compiled(function: Callable[..., Any], *, enabled: bool) -> Callable[..., Any]:
    """``torch.compile(function)`` if ``enabled``; where that does not work, the function itself, after one warning.

    Args:
        function: pure: tensors in, tensors out.
        enabled: whether compilation is asked for.

    Returns:
        A function of the same tensors, as positional arguments, with the same results to rounding.
    """
    if not enabled:
        return function
    fast = torch.compile(function, dynamic=True)  # the shield's rounds are of any size

    def call(*tensors: Tensor) -> Any:
        return (fast if _works(tensors[0].device.type) else function)(*tensors)

    return call


@functools.lru_cache(maxsize=8)
def _works(device: str) -> bool:
    """Whether torch.compile works here: tried once, on a tiny function."""
    try:
        torch.compile(lambda x: x + 1)(torch.zeros(2, device=device))
    except Exception as error:  # a missing C++ compiler, header or Triton has an error type of its own each
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(f"compile=true has no effect, torch.compile does not work on {device}: {reason}", stacklevel=3)
        return False
    return True
