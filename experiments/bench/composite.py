"""Compositing with warpfrag against dense PyTorch, eager and compiled, in one run; forward and forward + backward.

Two tables: smooth merging (SFM), with gradients in colour, opacity, depth, thickness and beta; and plain over
(`merge="none"`) against a cumulative product. Ratios are time of torch / time of warpfrag: above 1, warpfrag is faster.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import dense_torch
import torch
from measure import medians, memory_growth, milliseconds, quiet_warp, ragged, random_pixels, ratio, set_threads, show

quiet_warp()

import warpfrag as wf  # noqa: E402

BETA = 0.5
MAX_LAYERS = 8
# Pixels of the run whose memory predicts that of the first size.
PROBE_PIXELS = 128 * 128
WARPFRAG, EAGER, COMPILED = "warpfrag", "eager", "compile"


class Side(NamedTuple):
    """One implementation with its own leaf tensors; both sides' share memory."""

    function: Callable[..., torch.Tensor]
    inputs: tuple[torch.Tensor, ...]


class Contest(NamedTuple):
    """One table: what both composite, and how."""

    title: str
    tensors: tuple[str, ...]
    ours: Callable[[wf.Fragments, torch.Tensor, int], torch.Tensor]
    theirs: Callable[..., torch.Tensor]


def our_smooth(fragments: wf.Fragments, beta: torch.Tensor, per_pixel: int) -> torch.Tensor:
    """Merge smoothly and composite."""
    return wf.composite(fragments, beta, max_layers=MAX_LAYERS)


def their_smooth(rgba: torch.Tensor, depth: torch.Tensor, thickness: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
    """Merge smoothly and composite."""
    return dense_torch.composite(rgba, depth, thickness, beta, MAX_LAYERS)


def our_over(fragments: wf.Fragments, beta: torch.Tensor, per_pixel: int) -> torch.Tensor:
    """Composite by over, with as many layers as fragments, so that nothing goes to the tail."""
    return wf.composite(fragments, merge="none", max_layers=per_pixel)


SMOOTH = Contest(
    "Smooth merging (SFM), beta 0.5, 8 layers", ("rgba", "depth", "thickness", "beta"), our_smooth, their_smooth
)
OVER = Contest('Plain over (merge="none")', ("rgba",), our_over, dense_torch.over)


def sides(contest: Contest, pixel_count: int, per_pixel: int, theirs: Callable[..., torch.Tensor]) -> tuple[Side, Side]:
    """Return both sides for the same pixels; gradients are wanted in the contest's tensors."""
    dense = dict(
        zip(
            ("rgba", "depth", "thickness", "beta"),
            (*map(torch.from_numpy, random_pixels(pixel_count, per_pixel)), torch.tensor(BETA)),
            strict=True,
        )
    )
    fragments = ragged(*(dense[name] for name in ("rgba", "depth", "thickness")))
    flat = {"rgba": fragments.rgba, "depth": fragments.depth, "thickness": fragments.thickness}
    flat["beta"] = dense["beta"].clone()
    for name in contest.tensors:
        dense[name].requires_grad_()
        flat[name] = flat[name].detach().requires_grad_()
    beta = flat["beta"]
    leaves = tuple(flat[name] for name in contest.tensors)
    fragments = replace(fragments, **{name: flat[name] for name in ("rgba", "depth", "thickness")})
    return (
        Side(lambda *_: contest.ours(fragments, beta, per_pixel).reshape(-1, 4), leaves),
        Side(theirs, tuple(dense[name] for name in contest.tensors)),
    )


def forward(side: Side) -> tuple[torch.Tensor, ...]:
    """Compute the image alone."""
    with torch.no_grad():
        return (side.function(*side.inputs),)


def forward_backward(side: Side) -> tuple[torch.Tensor, ...]:
    """Compute the image, and the gradients in all inputs of a weighted sum of it."""
    image = side.function(*side.inputs)
    weights = torch.linspace(-1.0, 1.0, 4).expand_as(image).contiguous()
    return torch.autograd.grad(image, side.inputs, weights)


PASSES = {"forward": forward, "forward + backward": forward_backward}


def compile_for(function: Callable[..., torch.Tensor], threads: int) -> Callable[..., torch.Tensor]:
    """Compile a function for one shape and number of threads: both are part of the code."""
    import torch._inductor.config

    torch._dynamo.reset()
    torch._inductor.config.cpp.threads = threads
    return torch.compile(function, fullgraph=True, dynamic=False)


def check(contest: Contest) -> None:
    """Stop unless both implementations give the same image and gradients."""
    ours, theirs = sides(contest, 500, 16, contest.theirs)
    for run in PASSES.values():
        for one, other in zip(run(ours), run(theirs), strict=True):
            # Depth gradients go with 1/thickness: single precision leaves the dense formulas few digits there.
            error = float((one.reshape(other.shape) - other).norm() / other.norm())
            if not error < 1e-2:
                sys.exit(f"{contest.title}: warpfrag and torch differ by {error:.1e} of the norm")


def compare(contest: Contest, arguments: argparse.Namespace) -> None:
    """Time one contest at all sizes and thread counts, and print its table."""
    check(contest)
    memory = Memory(contest, arguments.fragments)
    rows, notes = [], []
    for threads in arguments.threads:
        set_threads(threads)
        for size in sorted(arguments.size):
            ours, eager = sides(contest, size * size, arguments.fragments, contest.theirs)
            competitors = {WARPFRAG: ours, EAGER: eager}
            if not arguments.no_compile:
                competitors[COMPILED] = Side(compile_for(contest.theirs, threads), eager.inputs)
            for name, run in PASSES.items():
                entries = {}
                for who, side in competitors.items():
                    gigabytes = memory.predict(who, name) * size * size / 1e9
                    if gigabytes > arguments.memory:
                        notes.append(f"{who}, {size}², {name}: left out, would take about {gigabytes:.1f} GB")
                    else:
                        entries[who] = partial(run, side)
                times = medians(entries, arguments.repetitions)
                memory.learn(name, entries, size * size)
                rows.append(row(size, threads, name, times, size * size * arguments.fragments))
    columns = ["size", "threads", "pass", "warpfrag", "M fragments/s", "eager / warpfrag", "compile / warpfrag"]
    show(f"{contest.title}, {arguments.fragments} fragments a pixel", columns, rows)
    print(*dict.fromkeys(notes), sep="\n")


def row(size: int, threads: int, name: str, times: dict[str, float], fragment_count: int) -> list[str]:
    """Return a row of the table."""
    ours = times.get(WARPFRAG)
    rate = "-" if ours is None else f"{fragment_count / ours / 1e6:.1f}"
    ratios = [ratio(times.get(who), ours) for who in (EAGER, COMPILED)]
    return [f"{size}²", str(threads), name, milliseconds(ours), rate, *ratios]


class Memory:
    """The bytes that each pass takes for a pixel: those of the size before, or else of a few pixels in eager mode."""

    def __init__(self, contest: Contest, per_pixel: int):
        """Measure the passes that are likely to take the most."""
        self.found: dict[tuple[str, str], float] = {}
        _, eager = sides(contest, PROBE_PIXELS, per_pixel, contest.theirs)
        self.eager = {name: probe(partial(run, eager), PROBE_PIXELS) for name, run in PASSES.items()}

    def predict(self, who: str, name: str) -> float:
        """Return the bytes a pixel takes."""
        # Compiled code holds no more than eager code; warpfrag's composite holds its inputs' gradients.
        return self.found.get((who, name), 0.0 if who == WARPFRAG else self.eager[name])

    def learn(self, name: str, entries: dict[str, Callable[[], Any]], pixel_count: int) -> None:
        """Measure what has just been timed: compiling is over."""
        for who, entry in entries.items():
            self.found.setdefault((who, name), memory_growth(entry)[0] / pixel_count)


def probe(entry: Callable[[], Any], pixel_count: int) -> float:
    """Return the bytes that a call takes for a pixel, the first call apart."""
    entry()
    return memory_growth(entry)[0] / pixel_count


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--size", type=int, nargs="+", default=[256, 1024], help="edges of the square image [pixels]")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="CPU threads")
    parser.add_argument("--fragments", type=int, default=16, help="fragments a pixel")
    parser.add_argument("--repetitions", type=int, default=7, help="timed calls of each function")
    parser.add_argument("--memory", type=float, default=12.0, help="skip what would take more than this [GB]")
    parser.add_argument("--table", choices=("smooth", "over"), nargs="+", default=["smooth", "over"], help="which")
    parser.add_argument("--no-compile", action="store_true", help="leave out torch.compile (it takes minutes)")
    arguments = parser.parse_args()
    for name, contest in (("smooth", SMOOTH), ("over", OVER)):
        if name in arguments.table:
            compare(contest, arguments)


if __name__ == "__main__":
    main()
