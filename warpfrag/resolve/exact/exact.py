"""Exact merging: all slabs of a pixel at once, instead of one after the other.

All fronts and backs cut the ray into intervals. In each, the parts of the slabs that fill it are mixed, and intervals
are composited by over: colour = sum_k P_k c_k with P_k the transmittance before interval k. A connected run of
overlapping slabs becomes a layer; what does not fit into `max_layers` is composited into the last one.

The result does not depend on any sequence: it is symmetric in the fragments, and continuous in depth and thickness
while t > 0. The cost of a pixel is that of sorting plus one step for every pair of an interval and a slab in it.

The opacity of a layer is that of its fragments, 1 - prod T_i, and has a gradient in nothing else. For the colour the
way back sweeps twice. First it records P_k, tau_k and <g, c_k>, from which follows <g, B_k>, B the colour behind. Then,
with dL/dc_k = P_k g and dL/dtau_k = P_k <g, B_k>, it takes the adjoint of each interval. Each thread has memory for
the fragments of one pixel. Differentiable in colour, opacity, depth, thickness, opacity sum and beta (also by
fragment); the order of the boundaries, runs and what falls into the tail are held fixed.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.legacy import Operator, apply
from warpfrag.fragments import Fragments
from warpfrag.resolve.arguments import (
    FRAGMENT_DIFFERENTIABLE,
    FRAGMENT_TENSORS,
    GRADIENTS,
    PIXELS,
    SLABS,
    Walk,
    fragment_inputs,
    report_invalid,
    sum_beta,
)
from warpfrag.resolve.exact.interval import blend, blend_adjoint, move_boundary
from warpfrag.resolve.exact.sweep import (
    BETA_FRAGMENT,
    BETA_ONE,
    BETA_PIXEL,
    Strip32,
    Strip64,
    Sweep32,
    Sweep64,
    advance,
    fragment_beta,
    in_progress,
    leave,
    load_strip,
)
from warpfrag.resolve.walk import NO_FRAGMENT, store_grad, valid_fragment, zero_slab

wp.set_module_options({"enable_backward": False})

SWEEPS: Any = {wp.float32: Sweep32, wp.float64: Sweep64}
STRIPS: Any = {wp.float32: Strip32, wp.float64: Strip64}
BETAS = {"one": BETA_ONE, "pixel": BETA_PIXEL, "fragment": BETA_FRAGMENT}

# The arrays of a strip; those of the way back are not allocated for the way forth.
STRIP_FORWARD = ("order", "active", "fragment", "rest")
STRIP_BY_FRAGMENT = (
    *("r", "power", "next_rest", "next_r", "next_power", "share", "pass_", "weight", "prefix", "veil", "cut"),
    *("grad", "grad_beta", "others", "run"),
)
STRIP_BY_INTERVAL = ("through", "tau", "behind", "layer")


@cache
def _forward_kernel(scalar: Any, mix: int, beta_per: int) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)
    sweep_type = SWEEPS[scalar]

    @wp.kernel(module="unique", enable_backward=False)
    def resolve_exact_fwd(
        span: Span,
        pixels: PIXELS[scalar],
        strip: STRIPS[scalar],
        invalid: wp.array2d(dtype=int),
        rgba: wp.array3d(dtype=scalar),
        depth: wp.array2d(dtype=scalar),
        thickness: wp.array2d(dtype=scalar),
        opacity_sum: wp.array2d(dtype=scalar),
        layer_count: wp.array(dtype=int),
    ):
        base = (span.worker + wp.tid()) * strip.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            for layer in range(pixels.max_layers):
                for channel in range(4):
                    rgba[pixel, layer, channel] = scalar(0.0)
                if depth.shape[0] > 0:
                    depth[pixel, layer] = scalar(0.0)
                    thickness[pixel, layer] = scalar(0.0)
                    opacity_sum[pixel, layer] = scalar(0.0)
            load_strip(pixels, begin, count, strip, base)
            for fragment in range(begin, begin + count):
                if not valid_fragment(pixels, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                beta = fragment_beta(pixels, pixel, fragment, beta_per)
                if not (beta >= scalar(0.0) and beta <= scalar(1.0)):
                    wp.atomic_min(invalid, span.worker, 1, wp.where(beta_per == BETA_FRAGMENT, fragment, pixel))
            layer = int(-1)
            color = vec3()
            opacity = scalar(0.0)
            through = scalar(1.0)
            clear = scalar(1.0)
            sum = scalar(0.0)
            front = scalar(0.0)
            sweep = sweep_type()
            # At most two intervals a fragment, whatever is in the arrays.
            steps = int(0)
            while in_progress(sweep, count) and steps < 2 * count:
                steps += 1
                sweep = advance(sweep, strip, base, count)
                if sweep.fresh:
                    through = clear
                    if layer < pixels.max_layers - 1:
                        layer += 1
                        color = vec3()
                        opacity = scalar(0.0)
                        through = scalar(1.0)
                        clear = scalar(1.0)
                        sum = scalar(0.0)
                        front = sweep.begin
                for position in range(sweep.entered, sweep.following):
                    opacity += clear * strip.fragment[base + position].a
                    clear *= strip.fragment[base + position].t
                part_color, tau, part_sum = blend(sweep, pixels, pixel, strip, base, mix, beta_per)
                color += through * part_color
                through *= tau
                sum += part_sum
                sweep = leave(sweep, strip, base)
                if sweep.active == 0:
                    rgba[pixel, layer, 0] = color[0]
                    rgba[pixel, layer, 1] = color[1]
                    rgba[pixel, layer, 2] = color[2]
                    rgba[pixel, layer, 3] = opacity
                    if depth.shape[0] > 0:
                        depth[pixel, layer] = sweep.end
                        thickness[pixel, layer] = sweep.end - front
                        opacity_sum[pixel, layer] = sum
            if layer_count.shape[0] > 0:
                layer_count[pixel] = layer + 1

    return resolve_exact_fwd


@cache
def _backward_kernel(scalar: Any, mix: int, beta_per: int) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)
    sweep_type = SWEEPS[scalar]

    @wp.kernel(module="unique", enable_backward=False)
    def resolve_exact_bwd(
        span: Span,
        pixels: PIXELS[scalar],
        strip: STRIPS[scalar],
        grad_rgba: wp.array3d(dtype=scalar),
        grad_depth: wp.array2d(dtype=scalar),
        grad_thickness: wp.array2d(dtype=scalar),
        grad_opacity_sum: wp.array2d(dtype=scalar),
        grads: GRADIENTS[scalar],
    ):
        base = (span.worker + wp.tid()) * strip.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            # What each interval shows, and the opacity gradient: prod of the other transmittances of the layer.
            load_strip(pixels, begin, count, strip, base)
            layer = int(-1)
            through = scalar(1.0)
            clear = scalar(1.0)
            g = vec3()
            sweep = sweep_type()
            steps = int(0)
            while in_progress(sweep, count) and steps < 2 * count:
                sweep = advance(sweep, strip, base, count)
                if sweep.fresh:
                    through = clear
                    if layer < pixels.max_layers - 1:
                        layer += 1
                        through = scalar(1.0)
                        clear = scalar(1.0)
                        if grad_rgba.shape[0] > 0:
                            g = vec3(grad_rgba[pixel, layer, 0], grad_rgba[pixel, layer, 1], grad_rgba[pixel, layer, 2])
                for position in range(sweep.entered, sweep.following):
                    strip.others[base + position] = clear
                    strip.run[base + position] = layer
                    clear *= strip.fragment[base + position].t
                part_color, tau, part_sum = blend(sweep, pixels, pixel, strip, base, mix, beta_per)
                strip.through[2 * base + steps] = through
                strip.tau[2 * base + steps] = tau
                strip.behind[2 * base + steps] = wp.dot(g, part_color)
                strip.layer[2 * base + steps] = layer
                through *= tau
                sweep = leave(sweep, strip, base)
                steps += 1
            interval_count = steps
            behind = scalar(0.0)
            following_layer = int(layer)
            for back in range(interval_count):
                at = 2 * base + interval_count - 1 - back
                if strip.layer[at] != following_layer:
                    behind = scalar(0.0)
                following_layer = strip.layer[at]
                visible = strip.behind[at]
                strip.behind[at] = behind
                behind = visible + strip.tau[at] * behind
            clear = scalar(1.0)
            following_layer = int(layer)
            for back in range(count):
                at = base + count - 1 - back
                own_layer = strip.run[at]
                if own_layer != following_layer:
                    clear = scalar(1.0)
                following_layer = own_layer
                grad = zero_slab(scalar(0.0))
                if grad_rgba.shape[0] > 0:
                    grad.a = grad_rgba[pixel, own_layer, 3] * strip.others[at] * clear
                clear *= strip.fragment[at].t
                strip.grad[at] = grad
                strip.grad_beta[at] = scalar(0.0)
                strip.cut[at] = scalar(0.0)
                strip.rest[at] = scalar(1.0)
                strip.r[at] = scalar(0.0)
                strip.power[at] = scalar(1.0)
            layer = int(-1)
            g_sum = scalar(0.0)
            sweep = sweep_type()
            for interval in range(interval_count):
                at = 2 * base + interval
                sweep = advance(sweep, strip, base, count)
                if strip.layer[at] != layer:
                    layer = strip.layer[at]
                    if grad_rgba.shape[0] > 0:
                        g = vec3(grad_rgba[pixel, layer, 0], grad_rgba[pixel, layer, 1], grad_rgba[pixel, layer, 2])
                    if grad_opacity_sum.shape[0] > 0:
                        g_sum = grad_opacity_sum[pixel, layer]
                    if grad_thickness.shape[0] > 0:
                        move_boundary(-grad_thickness[pixel, layer], sweep.begin_boundary, strip, base)
                through = strip.through[at]
                g_tau = through * strip.behind[at]
                blend_adjoint(through * g, g_tau, g_sum, sweep, pixels, pixel, strip, base, mix, beta_per)
                sweep = leave(sweep, strip, base)
                ends_layer = interval == interval_count - 1
                if not ends_layer:
                    ends_layer = strip.layer[at + 1] != layer
                if ends_layer:
                    g_back = scalar(0.0)
                    if grad_depth.shape[0] > 0:
                        g_back += grad_depth[pixel, layer]
                    if grad_thickness.shape[0] > 0:
                        g_back += grad_thickness[pixel, layer]
                    move_boundary(g_back, sweep.end_boundary, strip, base)
            g_beta = scalar(0.0)
            for position in range(count):
                fragment = strip.order[base + position]
                store_grad(strip.grad[base + position], pixels, fragment, grads)
                g_beta += strip.grad_beta[base + position]
                if beta_per == BETA_FRAGMENT and grads.beta.shape[0] > 0:
                    grads.beta[fragment] = strip.grad_beta[base + position]
            if beta_per != BETA_FRAGMENT and grads.beta.shape[0] > 0:
                grads.beta[pixel] = g_beta

    return resolve_exact_bwd


class ExactWalk(Walk):
    """`Walk` for exact merging: other scratch memory, and beta also by fragment."""

    def __init__(self, inputs: Sequence[Any], max_layers: int, mix: str, beta_per: str):
        super().__init__(inputs, max_layers, "exact", mix)
        self.choice = (self.choice[0], self.choice[2], BETAS[beta_per])
        self.beta_per = beta_per

    def strip(self, names: Sequence[str]) -> tuple[Any, int]:
        """Return scratch memory with the named arrays, and for how many threads it is."""
        types: dict[str, Any] = dict.fromkeys(("order", "active", "run", "layer"), wp.int32)
        types |= dict.fromkeys(("fragment", "grad"), SLABS[self.scalar])
        lengths = {name: self.length * (2 if name in STRIP_BY_INTERVAL else 1) for name in names}
        used = {name: types.get(name, self.scalar) for name in names}
        size = sum(lengths[name] * wp.types.type_size_in_bytes(used[name]) for name in names)
        rows = worker_count(self.pixel_count, self.device, size)
        strip = STRIPS[self.scalar]()
        strip.length = self.length
        for name in names:
            setattr(strip, name, wp.empty(rows * lengths[name], dtype=used[name], device=self.device))
        return strip, rows

    def forward(self, kernel: Callable[..., wp.Kernel], outputs: Sequence[wp.array]) -> None:
        """Run the kernel; raise if it finds invalid values."""
        strip, rows = self.strip(STRIP_FORWARD)
        invalid = wp.array(np.full((rows, 2), NO_FRAGMENT, np.int32), device=self.device)
        launch(kernel(*self.choice), self.pixel_count, [self.pixels, strip, invalid, *outputs], self.device, rows)
        report_invalid(invalid, self.inputs, "fragment" if self.beta_per == "fragment" else "pixel")

    def backward(
        self, kernel: Callable[..., wp.Kernel], grads: Sequence[wp.array], grad_inputs: Sequence[wp.array | None]
    ) -> None:
        """Run the kernel, which takes output gradients and fills input gradients."""
        strip, rows = self.strip((*STRIP_FORWARD, *STRIP_BY_FRAGMENT, *STRIP_BY_INTERVAL))
        targets, grad_beta = self.targets(grad_inputs), grad_inputs[4]
        if grad_beta is not None and self.beta_per == "fragment":
            targets.beta = grad_beta
        launch(kernel(*self.choice), self.pixel_count, [self.pixels, strip, *grads, targets], self.device, rows)
        if grad_beta is not None and self.beta_per != "fragment":
            sum_beta(targets.beta, grad_beta)


def _resolve_output_like(
    inputs: Sequence[Any], max_layers: int, mix: str, beta_per: str
) -> list[tuple[tuple[int, ...], str]]:
    pixel_count = inputs[3].shape[0] - 1
    per_layer = ((pixel_count, max_layers), "float")
    return [((pixel_count, max_layers, 4), "float"), per_layer, per_layer, per_layer, ((pixel_count,), "int32")]


def _resolve_forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    ExactWalk(inputs, **options).forward(_forward_kernel, outputs)


def _resolve_backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], **options: Any
) -> None:
    walk = ExactWalk(inputs, **options)
    grads = [walk.optional(grad, ndim) for grad, ndim in zip(grad_outputs[:4], (3, 2, 2, 2), strict=True)]
    walk.backward(_backward_kernel, grads, grad_inputs)


def _composite_output_like(inputs: Sequence[Any], mix: str, beta_per: str) -> list[tuple[tuple[int, ...], str]]:
    return [((inputs[3].shape[0] - 1, 4), "float")]


def _composite_forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    # Over is associative: the image is the only layer of M = 1.
    walk = ExactWalk(inputs, 1, **options)
    nothing = [walk.optional(None, 2)] * 3
    count = wp.empty(0, dtype=wp.int32, device=walk.device)
    walk.forward(_forward_kernel, [outputs[0].reshape((walk.pixel_count, 1, 4)), *nothing, count])


def _composite_backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], **options: Any
) -> None:
    walk = ExactWalk(inputs, 1, **options)
    nothing = [walk.optional(None, 2)] * 3
    walk.backward(_backward_kernel, [grad_outputs[0].reshape((walk.pixel_count, 1, 4)), *nothing], grad_inputs)


RESOLVE_EXACT = Operator(
    name="resolve_exact",
    tensors=FRAGMENT_TENSORS,
    differentiable=FRAGMENT_DIFFERENTIABLE,
    outputs=("rgba", "depth", "thickness", "opacity_sum", "count"),
    output_like=_resolve_output_like,
    forward=_resolve_forward,
    backward=_resolve_backward,
    options={"max_layers": "int", "mix": "str", "beta_per": "str"},
)

COMPOSITE_EXACT = Operator(
    name="composite_exact",
    tensors=FRAGMENT_TENSORS,
    differentiable=FRAGMENT_DIFFERENTIABLE,
    outputs=("image",),
    output_like=_composite_output_like,
    forward=_composite_forward,
    backward=_composite_backward,
    options={"mix": "str", "beta_per": "str"},
)


def apply_exact(
    operator: Operator, fragments: Fragments, beta: Any, *, dimensions: int, **options: Any
) -> tuple[Any, ...]:
    """Apply one of the two operators to fragments; beta may also be one value per fragment, (F,).

    Args:
        operator: `RESOLVE_EXACT` or `COMPOSITE_EXACT`.
        fragments: what to merge.
        beta: see `resolve`.
        dimensions: how many the outputs have beside those of the pixel grid.
        options: those of the operator but `beta_per`.
    """
    inputs = fragment_inputs(fragments, beta, dimensions=dimensions, by_fragment=True)
    beta_per = "one" if inputs[4].shape[0] == 1 else "fragment"
    if beta_per == "fragment" and tuple(beta.shape) == tuple(fragments.shape):
        beta_per = "pixel"
    return apply(operator, inputs, beta_per=beta_per, **options)
