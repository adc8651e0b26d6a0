"""Optional CUDA graphs of functions of tensors: the kernels of a call are recorded once and launched together from then on.

A small batch leaves a GPU idle while the host launches one kernel after the other; a graph takes that time away. What is
recorded is the kernels with the addresses they read and write, so nothing in the function may depend on the data but the
numbers themselves (:mod:`envs.selection`), and what it reads besides its arguments must stay where it is.
"""

import functools
import gc
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

WARM_UP = 3
"""Calls before the recording: they make what is made once (layouts, optimiser states, compiled code)."""
MOST = 16
"""Recordings of a function, each of which holds memory; other shapes are then computed as without."""

Outputs = Tensor | tuple[Tensor, ...] | dict[str, Tensor]


class Recording(Protocol):
    """A function's operations on tensors that stay where they are."""

    outputs: Outputs
    """What the function returned, rewritten by every replay."""

    def replay(self) -> None:
        """Do them once, on what the inputs now hold."""
        ...


class CudaRecording:
    """A CUDA graph.

    Args:
        function: what is recorded, without being carried out.
        inputs: its arguments.
    """

    def __init__(self, function: Callable[..., Outputs], inputs: Sequence[Tensor]) -> None:
        self.graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
        gc.disable()  # it might free another graph, which must not happen now
        try:
            with torch.cuda.device(inputs[0].device), torch.cuda.graph(self.graph, capture_error_mode="thread_local"):
                self.outputs = function(*inputs)
        finally:
            if collects:
                gc.enable()

    def replay(self) -> None:
        """Launch it."""
        self.graph.replay()


def recorder_for(tensor: Tensor) -> Callable[[Callable[..., Outputs], Sequence[Tensor]], Recording] | None:
    """What records functions of tensors on this one's device; None where they are called as they are."""
    return CudaRecording if tensor.is_cuda else None


class Graphed:
    """A function of tensors, recorded at the fourth call with arguments of the same shapes and replayed from then on.

    The same kernels on the same numbers: the function's own results (but for cuBLAS, which rounds differently on other streams).
    It may write into tensors that it holds (networks, moments), but must neither draw random numbers nor ask for a tensor's value.

    Args:
        function: tensors in, as positional arguments; a tensor out, or a tuple or dictionary of them.
        learns: whether it computes gradients itself and returns none. Another function is recorded only where gradients are off.
    """

    def __init__(self, function: Callable[..., Outputs], *, learns: bool = False) -> None:
        self.function, self.learns = function, learns
        self.calls: Counter[tuple] = Counter()
        self.recordings: dict[tuple, tuple[list[Tensor], Recording]] = {}

    def __reduce__(self) -> tuple[Callable, tuple]:
        """Copies and pickles record anew."""
        return functools.partial(Graphed, learns=self.learns), (self.function,)

    def __call__(self, *tensors: Tensor) -> Any:
        """The function's result, in tensors of its own."""
        record = recorder_for(tensors[0])
        if record is None or (torch.is_grad_enabled() and not self.learns):
            return self.function(*tensors)
        sizes = ((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors)
        key = (torch.is_inference_mode_enabled(), *sizes)
        if key not in self.recordings:
            if len(self.recordings) == MOST:
                return self.function(*tensors)
            self.calls[key] += 1
            if self.calls[key] <= WARM_UP:
                return _beside(self.function, tensors)
            inputs = [tensor.clone() for tensor in tensors]
            self.recordings[key] = (inputs, record(self.function, inputs))
        inputs, recording = self.recordings[key]
        torch._foreach_copy_(inputs, tensors)
        recording.replay()
        return _copies(recording.outputs)


def _copies(outputs: Outputs) -> Outputs:
    if isinstance(outputs, Tensor):
        return outputs.clone()
    if isinstance(outputs, dict):
        return {name: value.clone() for name, value in outputs.items()}
    return tuple(value.clone() for value in outputs)


def _beside(function: Callable[..., Outputs], tensors: Sequence[Tensor]) -> Outputs:
    """The result, on a GPU by way of another stream: gradients' bookkeeping then does not hold on to the usual one."""
    if not tensors[0].is_cuda:
        return function(*tensors)
    usual, other = torch.cuda.current_stream(tensors[0].device), torch.cuda.Stream(tensors[0].device)
    other.wait_stream(usual)
    with torch.cuda.stream(other):
        outputs = function(*tensors)
    usual.wait_stream(other)
    return outputs


def graphed(function: Callable[..., Any], *, enabled: bool) -> Callable[..., Any]:
    """``function``, or its :class:`Graphed` form if ``enabled``."""
    return Graphed(function) if enabled else function


def check_graphs(*, cuda_graphs: bool, fixed_sizes: bool) -> None:
    """Raise a ``ValueError`` if graphs are asked for where sizes depend on the data."""
    if cuda_graphs and not fixed_sizes:
        raise ValueError(
            "cuda_graphs=true cannot record operations whose sizes depend on the data, as with fixed_sizes=false: set "
            "fixed_sizes=true too."
        )
