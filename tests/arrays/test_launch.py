"""Images, layers and gradients have the same bits for any number of threads."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import warp as wp
from fragment_arrays import fragments_of
from pixels import Pixels, random_pixels

import warpfrag as wf
from warpfrag.arrays.launch import SMALLEST_PIECE, Span, launch, share, thread_count, worker_count

THREADS = (1, 2, 3, 8)
PIXEL_COUNT = 40 * SMALLEST_PIECE + 17


@pytest.fixture(scope="module")
def many_pixels() -> Pixels:
    """A set of degenerate pixels over and over, crowded and empty ones in turns: enough for many pieces."""
    few = random_pixels(1, 401)
    repeats = -(-PIXEL_COUNT // 401)
    counts = np.tile(np.diff(few.offsets), repeats)[:PIXEL_COUNT]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    values = [np.concatenate([v] * repeats)[: offsets[-1]] for v in few[:3]]
    return Pixels(*values, offsets)


def results(pixels: Pixels, dtype: str) -> list[torch.Tensor]:
    """Return image, layers and all gradients, of pixels with a beta for all and one of their own."""
    fragments = fragments_of(
        pixels, dtype, kind="torch", requires_grad=True, opacity_sum=1.5 * pixels.rgba[:, 3], shape=(1, PIXEL_COUNT)
    )
    inputs = [fragments.rgba, fragments.depth, fragments.thickness, fragments.opacity_sum]
    found = []
    for shape in ((), (1, PIXEL_COUNT)):
        beta = torch.full(shape, 0.3, dtype=getattr(torch, dtype), requires_grad=True)
        image = wf.composite(fragments, beta, max_layers=3)
        weights = torch.linspace(-1.0, 1.0, image.numel(), dtype=image.dtype).reshape(image.shape)
        found += [image, *torch.autograd.grad((image * weights).sum(), [*inputs, beta])]
    layers = wf.resolve(fragments, 0.3, max_layers=3)
    found += vars(layers).values()
    found += torch.autograd.grad(layers.depth.sum() + wf.composite(layers).square().sum(), inputs)
    return found


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bits_do_not_depend_on_threads(monkeypatch, many_pixels, dtype):
    """1, 2, 3 and 8 threads, more than there are cores, and whatever the default is."""
    monkeypatch.delenv("WARPFRAG_THREADS", raising=False)
    expected = results(many_pixels, dtype)
    for threads in THREADS:
        monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
        for one, other in zip(results(many_pixels, dtype), expected, strict=True):
            assert torch.equal(one, other), threads


def test_repeated_pixels_have_the_same_bits(many_pixels):
    """Wherever a piece begins: the image repeats as its pixels do."""
    image = wf.composite(fragments_of(many_pixels, "float32"), 0.3)[0]
    np.testing.assert_array_equal(image[401:], image[:-401])


def test_number_may_change_between_forward_and_backward(monkeypatch, many_pixels):
    """Scratch memory belongs to a pass."""
    monkeypatch.setenv("WARPFRAG_THREADS", "1")
    found = []
    for threads in ("1", "8"):
        fragments = fragments_of(many_pixels, kind="torch", requires_grad=True)
        image = wf.composite(fragments)
        monkeypatch.setenv("WARPFRAG_THREADS", threads)
        found += torch.autograd.grad(image.square().sum(), fragments.depth)
    assert torch.equal(*found)


def test_errors_name_the_first_fragment_whatever_thread_finds_one(monkeypatch, many_pixels):
    """Three are wrong, in different pieces."""
    thickness = many_pixels.thickness.copy()
    thickness[[1000, 30000, 5000]] = -1.0
    for threads in THREADS:
        monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
        with pytest.raises(ValueError, match="in fragment 1000, expected"):
            wf.composite(fragments_of(many_pixels._replace(thickness=thickness)))


def test_callers_may_be_threads_themselves(many_pixels):
    """Several threads of the user's call at once: each gets its own image."""
    betas = np.linspace(0.0, 1.0, 6)
    fragments = fragments_of(many_pixels)
    expected = [wf.composite(fragments, beta) for beta in betas]
    with ThreadPoolExecutor(3) as pool:
        images = list(pool.map(lambda beta: wf.composite(fragments, beta), betas))
    for image, wanted in zip(images, expected, strict=True):
        np.testing.assert_array_equal(image, wanted)


@wp.kernel(module="unique", enable_backward=False)
def visit(span: Span, visits: wp.array[int], workers: wp.array[int]):
    """Count the visits of each item, and note who made them."""
    for item in range(span.begin + wp.tid(), span.end, span.stride):
        visits[item] = visits[item] + 1
        workers[item] = span.worker + wp.tid()


@pytest.mark.parametrize("size", [0, 1, SMALLEST_PIECE - 1, 2 * SMALLEST_PIECE, 16 * SMALLEST_PIECE + 1, 100_003])
@pytest.mark.parametrize("threads", THREADS)
def test_every_item_is_visited_once(monkeypatch, device, size, threads):
    """By a thread whose number is below the number of rows of scratch memory."""
    monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
    visits, workers = (wp.zeros(size, dtype=wp.int32, device=device) for _ in range(2))
    rows = worker_count(size, visits.device, 8)
    launch(visit, size, [visits, workers], visits.device, rows)
    assert (visits.numpy() == 1).all()
    assert size == 0 or 0 <= workers.numpy().min() <= workers.numpy().max() < rows


@pytest.mark.parametrize("setting", ["0", "-1", "two", "1.5", ""])
def test_wrong_setting_is_an_error(monkeypatch, setting):
    """Named, with what is expected."""
    monkeypatch.setenv("WARPFRAG_THREADS", setting)
    with pytest.raises(ValueError, match=f"WARPFRAG_THREADS: got '{setting}', expected a whole number of at least 1"):
        thread_count()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system cannot fork")
def test_forked_process_has_threads_of_its_own():
    """A data loader's worker inherits a pool without its threads: it makes another one instead of waiting for them."""
    program = """
import os, signal
import numpy as np
import warpfrag as wf
os.environ["WARPFRAG_THREADS"] = "2"
count = 4096
fragments = wf.Fragments(np.full((count, 4), 0.5), np.ones(count), np.zeros(count), np.arange(count + 1), (64, 64))
expected = wf.composite(fragments, merge="none")
child = os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(0 if np.array_equal(wf.composite(fragments, merge="none"), expected) else 1)
print("child", os.waitpid(child, 0)[1])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("child 0\n"), done.stdout + done.stderr


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_shared_work_comes_back_in_order(monkeypatch, threads):
    """Whoever did a part, its result stands in its place; an error in any part is raised."""
    monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
    assert share(lambda part: 2 * part, list(range(9))) == list(range(0, 18, 2))
    assert share(str, []) == []
    with pytest.raises(ZeroDivisionError):
        share(lambda part: 1 // (part - 7), list(range(9)))
