"""Stochastic transparency (Enderton, Sintorn, Shirley and Luebke, I3D 2010).

A pixel has S samples with a depth test. A fragment of opacity A covers R of them, drawn without replacement; R is A S
rounded up or down at random such that its mean is A S. Every sample then shows its nearest fragment, opaquely:

    C = 1/S sum_s c(s),   c = C_i / A_i

The mean over seeds is the sorted image: sample s sees fragment i with the probability A_i prod_{j < i} (1 - A_j). Alpha
correction replaces the opacity, which is the share of covered samples, by the exact one and scales the colour along:
less noise, at the price of a small bias.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span
from warpfrag.arrays.precisions import kernels
from warpfrag.baselines.inputs import exact_image
from warpfrag.baselines.sequential import blend, sequential_operator
from warpfrag.errors import check_whole
from warpfrag.fragments import Fragments

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class StochasticOptions:
    """Number of samples, and the seed."""

    samples: int
    seed: int


@kernels
def stochastic_fwd(number: Any) -> Any:
    """Return the kernel."""
    vec4 = wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array(dtype=vec4),
        depth: wp.array(dtype=number),
        offsets: wp.array(dtype=int),
        exact: wp.array(dtype=vec4),
        sample_count: int,
        seed: int,
        nearest: wp.array2d(dtype=int),
        image: wp.array(dtype=vec4),
    ):
        """Let fragments cover samples of each pixel.

        Args:
            span: pixels.
            rgba: colour and opacity of the fragments, (F,).
            depth: depth of the fragments [scene units], (F,).
            offsets: where each pixel's fragments begin, (P + 1,).
            exact: image of plain over, (P,), or empty.
            sample_count: number of samples S.
            seed: of the draws.
            nearest: scratch memory: the nearest fragment of each sample, (threads, S).
            image: output, (P,).
        """
        row = span.worker + wp.tid()
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            random = wp.rand_init(seed, pixel)
            for sample in range(sample_count):
                nearest[row, sample] = -1
            for fragment in range(offsets[pixel], offsets[pixel + 1]):
                # Selection sampling: each sample takes its chance at the rest of the draws.
                expected = float(rgba[fragment][3]) * float(sample_count)
                missing = int(wp.floor(expected + wp.randf(random)))
                for sample in range(sample_count):
                    if wp.randf(random) * float(sample_count - sample) < float(missing):
                        missing -= 1
                        kept = nearest[row, sample]
                        if kept < 0 or depth[fragment] < depth[kept]:
                            nearest[row, sample] = fragment
            sum = vec4()
            for sample in range(sample_count):
                if nearest[row, sample] >= 0:
                    seen = rgba[nearest[row, sample]]
                    sum += seen / seen[3]
            sum /= number(sample_count)
            if exact.shape[0] > 0:
                opacity = exact[pixel][3]
                if sum[3] > number(0.0):
                    sum *= opacity / sum[3]
                sum[3] = opacity
            image[pixel] = sum

    return kernel


def _nodes(number: Any, options: StochasticOptions) -> Sequence[tuple[Any, int]]:
    return [(wp.int32, options.samples)]


_STOCHASTIC = sequential_operator(
    "stochastic_transparency", stochastic_fwd, _nodes, StochasticOptions, takes_exact=True
)


def stochastic_transparency(
    fragments: Fragments, *, samples: int = 8, seed: int = 0, alpha_correction: bool = True
) -> Any:
    """Let fragments cover random samples of a pixel, opaquely (Enderton et al. 2010).

    Emission without opacity covers no sample and is lost. Not differentiable.

    Args:
        fragments: what to blend; the draws go by the order of submission.
        samples: number S of samples per pixel, at least 1.
        seed: the image is the same for the same seed, from 0 to 2^31 - 1.
        alpha_correction: take the exact opacity; where no sample was covered, the colour is black.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the fragments.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: values are not finite or out of range.
    """
    samples = check_whole("samples", samples, 1)
    seed = check_whole("seed", seed, 0, 2**31 - 1)
    exact = exact_image(fragments)
    return blend(_STOCHASTIC, fragments, StochasticOptions(samples, seed), exact if alpha_correction else None)
