"""Devices by their names: "cpu", "cuda", "cuda:<number>"."""

import re
from typing import Any

import warp as wp

from warpfrag.errors import shorten


def check_device(device: Any) -> str | None:
    """Return the name of a device of this machine; None stays.

    Args:
        device: "cpu", "cuda" or "cuda:<number>", or a `wp.Device` or `torch.device`.

    Raises:
        ValueError: there is no such device here.

    Example:
        >>> check_device("cpu")
        'cpu'
    """
    if device is None:
        return None
    name = str(device)
    match = re.fullmatch(r"cpu|cuda(?::(\d{1,4}))?", name)
    if match is None:
        raise ValueError(f'device: got {shorten(name)}, expected "cpu", "cuda" or "cuda:<number>"')
    count = 0 if name == "cpu" else wp.get_cuda_device_count()
    if name != "cpu" and int(match[1] or 0) >= count:
        here = f"{count} CUDA devices" if count else "no CUDA device"
        raise ValueError(f'device: got "{name}" on a machine with {here}, expected another, such as "cpu"')
    return name
