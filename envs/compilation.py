"""Optional torch.compile of pure tensor functions: same results to rounding, and never a reason to fail."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class Compiled:
    """A pure function of tensors, compiled at its first call; where that fails, the function itself, after one warning.

    Args:
        function: tensors in, as positional arguments, tensors out.
        dynamic: once for any sizes, as a selection's; otherwise for each size anew, to faster code.
    """

    warned = False

    def __init__(self, function: Callable[..., Any], *, dynamic: bool = True) -> None:
        self.function, self.dynamic = function, dynamic
        self.fast: Callable[..., Any] | None = torch.compile(function, dynamic=dynamic)

    def __reduce__(self) -> tuple[Callable, tuple]:
        """Copies and pickles compile anew."""
        return functools.partial(Compiled, dynamic=self.dynamic), (self.function,)

    def __call__(self, *tensors: Tensor) -> Any:
        """The function's result, to rounding."""
        if self.fast is not None:
            try:
                return self.fast(*tensors)
            except Exception as error:  # a missing C++ compiler, header or Triton has an error type of its own each
                self.fast = None
                if not Compiled.warned:
                    reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                    warnings.warn(
                        f"compile=true has no effect, torch.compile does not work here: {reason}", stacklevel=2
                    )
                    Compiled.warned = True
        return self.function(*tensors)


def compiled(function: Callable[..., Any], *, enabled: bool, dynamic: bool = True) -> Callable[..., Any]:
    """``function``, or its :class:`Compiled` form if ``enabled``."""
    return Compiled(function, dynamic=dynamic) if enabled else function
