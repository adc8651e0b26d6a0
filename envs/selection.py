"""What an operation looks at: only what needs it, or everything where no size may depend on the data.

Selecting is fast on a CPU. On a GPU the host waits for the size of every selection, and neither CUDA graphs nor whole-function
compilation can hold one.
"""

import torch
from torch import Tensor


def places(mask: Tensor, *, fixed_sizes: bool) -> tuple[Tensor, ...]:
    """Places where ``mask`` is true, ``(K,)`` int64 per dimension; with ``fixed_sizes`` all of the mask's places.

    For uses in which an entry that does not need it comes out as it was.
    """
    if not fixed_sizes:
        return mask.nonzero(as_tuple=True)
    ranges = [torch.arange(size, device=mask.device) for size in mask.shape]
    return tuple(x.flatten() for x in torch.meshgrid(*ranges, indexing="ij"))
