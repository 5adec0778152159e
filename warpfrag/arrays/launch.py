"""Launching kernels on CUDA, and on the CPU over a pool of threads.

A Warp CPU launch runs on one thread and lets go of the GIL, so a launch over pixels is cut into pieces that a few
threads share. Every kernel takes a `Span` first and loops over it:

    for pixel in range(span.begin + wp.tid(), span.end, span.stride):

On the CPU each piece is one launch of one thread over consecutive items; on CUDA one launch covers everything. Scratch
memory belongs to the row `span.worker + wp.tid()`, one per thread that runs at the same time. As no two pieces write
the same address, results have the same bits for any number of threads.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import warp as wp

# Handing a piece to a thread costs about 80 microseconds, so pieces are not cut smaller than this many items.
SMALLEST_PIECE = 256
# Pieces a thread takes on average: enough that one crowded region of the image does not leave the others waiting.
PIECES_PER_THREAD = 8
# Scratch memory on CUDA: rows for as many concurrent threads as this many bytes hold.
CUDA_SCRATCH_BYTES = 1 << 28
CUDA_MOST_WORKERS = 1 << 17


@wp.struct
class Span:
    """The items one launch goes through: `begin + tid, begin + tid + stride, …` up to `end`."""

    begin: wp.int32
    end: wp.int32
    stride: wp.int32
    worker: wp.int32


def thread_count() -> int:
    """Return how many CPU threads kernels run on: `WARPFRAG_THREADS`, or all cores this process may use.

    Raises:
        ValueError: `WARPFRAG_THREADS` is not a whole number of at least 1.
    """
    setting = os.environ.get("WARPFRAG_THREADS")
    if setting is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not setting.isdecimal() or int(setting) < 1:
        raise ValueError(f"WARPFRAG_THREADS: got {setting!r}, expected a whole number of at least 1")
    return int(setting)


def worker_count(size: int, device: wp.Device, bytes_per_worker: int) -> int:
    """Return how many threads may run at once over `size` items, each with its own row of scratch memory."""
    if device.is_cpu:
        return max(1, min(thread_count(), size))
    return max(1, min(size, CUDA_MOST_WORKERS, CUDA_SCRATCH_BYTES // max(1, bytes_per_worker)))


def launch(kernel: wp.Kernel, size: int, inputs: Sequence[Any], device: wp.Device, workers: int | None = None) -> None:
    """Run `kernel` over `size` items.

    Args:
        kernel: a kernel whose first argument is a `Span`.
        size: number of items.
        inputs: the kernel's arguments after the span.
        device: where to run.
        workers: most threads that may run at once; what `worker_count` said when scratch memory was allocated.
    """
    if size <= 0:
        return
    if not device.is_cpu:
        stride = min(size, workers or size)
        wp.launch(kernel, dim=stride, inputs=[_span(0, size, stride, 0), *inputs], device=device, record_tape=False)
        return
    threads = min(workers or thread_count(), max(1, size // SMALLEST_PIECE))
    if threads == 1:
        wp.launch(kernel, dim=1, inputs=[_span(0, size, 1, 0), *inputs], device=device, record_tape=False)
        return
    # Loading a module from several threads at once is not safe. CPU kernels are launched with blocks of one.
    wp.load_module(kernel.module, device, block_dim=1)
    piece = max(SMALLEST_PIECE, -(-size // (threads * PIECES_PER_THREAD)))
    # One iterator for all: each thread takes the next piece when it is done with one.
    begins = iter(range(0, size, piece))

    def work(worker: int) -> None:
        for begin in begins:
            span = _span(begin, min(begin + piece, size), 1, worker)
            wp.launch(kernel, dim=1, inputs=[span, *inputs], device=device, record_tape=False)

    share(work, range(threads))


def share(work: Callable[[Any], Any], parts: Sequence[Any]) -> list[Any]:
    """Return what a function gives for each part, a thread for each; it should let go of the GIL."""
    others = [_pool(len(parts) - 1).submit(work, part) for part in parts[1:]]
    try:
        first = [work(part) for part in parts[:1]]
    finally:
        rest = [other.result() for other in others]
    return first + rest


def _span(begin: int, end: int, stride: int, worker: int) -> Span:
    span = Span()
    span.begin, span.end, span.stride, span.worker = begin, end, stride, worker
    return span


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="warpfrag")


if hasattr(os, "register_at_fork"):
    # A forked process inherits pools without their threads, and would wait for those forever.
    os.register_at_fork(after_in_child=_pool.cache_clear)
