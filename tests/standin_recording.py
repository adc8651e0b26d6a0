"""A recording without a GPU: the operations of a function on tensors, done again in the same memory, as a CUDA graph does.

Nothing of Python runs at a replay, arguments that are numbers stay what they were, and tensors keep their memory. What a
CUDA graph cannot hold, numbers read by the host, sizes that depend on the data, tensors made from the host's numbers and random
numbers, raises here too.
"""

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

ATEN = torch.ops.aten
NOT_RECORDABLE = {ATEN.equal, ATEN.lift_fresh, ATEN.masked_select, ATEN.repeat_interleave}
TAGS = {torch.Tag.nondeterministic_seeded, torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape}
INDEXED = {ATEN.index, ATEN.index_put, ATEN.index_put_, ATEN._index_put_impl_}


def by_mask(func, args) -> bool:
    """Whether an operation selects by a mask: its size depends on the data."""
    return func.overloadpacket in INDEXED and any(index is not None and index.dtype == torch.bool for index in args[1])


def in_parts(mode, func, args, kwargs):
    """The result of an operation made of others, which ``mode`` then sees one by one; NotImplemented for any other.

    In inference mode PyTorch shows such operations to a mode as they are.
    """
    with mode:
        return func.decompose(*args, **(kwargs or {}))


class StandInRecording(TorchDispatchMode):
    """As :class:`envs.graphs.CudaRecording`, on any device.

    Args:
        function: what is recorded, and carried out; the first replay only says so.
        inputs: its arguments.
    """

    made = 0
    replays = 0

    def __init__(self, function, inputs):
        super().__init__()
        self.operations = []
        self.done = True
        with self:
            self.outputs = function(*inputs)
        StandInRecording.made += 1

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if (parts := in_parts(self, func, args, kwargs)) is not NotImplemented:
            return parts
        packet = func.overloadpacket
        refused = packet in NOT_RECORDABLE or (packet not in INDEXED and TAGS & set(func.tags))
        if refused or by_mask(func, args):
            raise RuntimeError(f"{func} cannot be recorded")
        out = func(*args, **(kwargs or {}))
        self.operations.append((func, args, kwargs or {}, out))
        return out

    @torch.no_grad()
    def replay(self):
        StandInRecording.replays += 1
        if self.done:
            self.done = False
            return
        for func, args, kwargs, out in self.operations:
            for old, new in zip(tree_leaves(out), tree_leaves(func(*args, **kwargs)), strict=True):
                if (
                    isinstance(old, torch.Tensor)
                    and old.untyped_storage().data_ptr() != new.untyped_storage().data_ptr()
                ):
                    old.copy_(new)  # elsewhere a view, or written in place
