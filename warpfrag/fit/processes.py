"""Several processes that fit together: each looks at its share of the views, and they add up what they find.

`torchrun` starts them and tells each its rank. Sums go over all processes in one vector and come out with the same bits
everywhere, so that all of them take the same steps; only the first writes files and reports. On the CPU they talk by
gloo, on CUDA by NCCL.
"""

import os
from typing import Any

import numpy as np

from warpfrag.extras import need


def is_first_process() -> bool:
    """Whether this is the process that writes and reports: the only one, or torchrun's first."""
    return int(os.environ.get("RANK", "0")) == 0


class Processes:
    """The processes of a fit; a single one unless torchrun started this program.

    Args:
        device: where the study computes, which decides how they talk.
    """

    def __init__(self, device: str) -> None:
        self.count, self.rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
        self.device = device
        self._group: Any = None
        if self.count == 1:
            return
        torch = need("torch", "torch", "A fit in several processes")
        distributed = need("torch.distributed", "torch", "A fit in several processes")
        if device.startswith("cuda"):
            # Each process has a device of its own.
            self.device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
            torch.cuda.set_device(self.device)
        if not distributed.is_initialized():
            distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        self._group = distributed

    def share(self, views: list[int]) -> list[int]:
        """Return those of some views that this process looks at."""
        return views[self.rank :: self.count]

    def sum(self, vector: np.ndarray) -> np.ndarray:
        """Return the sum of the processes' vectors, float64, with the same bits in all of them."""
        if self._group is None:
            return vector
        import torch

        tensor = torch.as_tensor(vector, dtype=torch.float64, device=self.device).clone()
        self._group.all_reduce(tensor)
        return tensor.cpu().numpy()

    def gather(self, array: np.ndarray) -> list[np.ndarray]:
        """Return the arrays of all processes, float64 and of one shape, in order of rank."""
        if self._group is None:
            return [array]
        import torch

        tensor = torch.as_tensor(array, dtype=torch.float64, device=self.device)
        parts = [torch.empty_like(tensor) for _ in range(self.count)]
        self._group.all_gather(parts, tensor.contiguous())
        return [part.cpu().numpy() for part in parts]
