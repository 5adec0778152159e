"""Compositing: layers, or fragments straight away, to an image.

    C = sum_i T_i C_i,   A = 1 - prod_i (1 - A_i),   T_i = prod_{j < i} (1 - A_j)   (premultiplied, front to back)

On the way back the colour B_i behind layer i is carried along instead of being divided out:

    dL/dC_i = T_i g,   dL/d(1 - A_i) = T_i (g . B_i - g_A T_behind),   B_{i-1} = C_i + (1 - A_i) B_i

so opaque layers have exact gradients. Everything is differentiable; the fused version holds fixed what `resolve` does.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

from warpfrag.arrays.launch import Span, launch
from warpfrag.arrays.legacy import Operator, apply, vectors
from warpfrag.fragments import Fragments, Layers
from warpfrag.resolve.arguments import (
    FRAGMENT_DIFFERENTIABLE,
    FRAGMENT_TENSORS,
    GRADIENTS,
    MERGE_OPTIONS,
    PIXELS,
    SCRATCH,
    Merge,
    Mix,
    Walk,
    as_int32,
    check_options,
    fragment_inputs,
)
from warpfrag.resolve.exact.exact import COMPOSITE_EXACT, apply_exact
from warpfrag.resolve.walk import (
    STEP_START,
    choose_step,
    load_slab,
    pixel_beta,
    replay,
    sort_pixel,
    step_powers,
    store_grad,
    take_step,
    take_step_adjoint,
    valid_beta,
    valid_fragment,
    zero_slab,
)

wp.set_module_options({"enable_backward": False})


@cache
def _layers_forward_kernel(scalar: Any) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def composite_layers_fwd(
        span: Span,
        rgba: wp.array3d(dtype=scalar),
        count: wp.array(dtype=int),
        image: wp.array2d(dtype=scalar),
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            transmittance = scalar(1.0)
            red = scalar(0.0)
            green = scalar(0.0)
            blue = scalar(0.0)
            for layer in range(wp.clamp(count[pixel], 0, rgba.shape[1])):
                red += transmittance * rgba[pixel, layer, 0]
                green += transmittance * rgba[pixel, layer, 1]
                blue += transmittance * rgba[pixel, layer, 2]
                transmittance *= scalar(1.0) - rgba[pixel, layer, 3]
            image[pixel, 0] = red
            image[pixel, 1] = green
            image[pixel, 2] = blue
            image[pixel, 3] = scalar(1.0) - transmittance

    return composite_layers_fwd


@cache
def _layers_backward_kernel(scalar: Any) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_layers_bwd(
        span: Span,
        rgba: wp.array3d(dtype=scalar),
        count: wp.array(dtype=int),
        grad_image: wp.array2d(dtype=scalar),
        grad_rgba: wp.array3d(dtype=scalar),
    ):
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            layer_count = wp.clamp(count[pixel], 0, rgba.shape[1])
            # The transmittance up to each layer waits where its opacity's gradient will be.
            transmittance = scalar(1.0)
            for layer in range(rgba.shape[1]):
                grad_rgba[pixel, layer, 3] = wp.where(layer < layer_count, transmittance, scalar(0.0))
                transmittance *= scalar(1.0) - rgba[pixel, layer, 3]
            g = vec3(grad_image[pixel, 0], grad_image[pixel, 1], grad_image[pixel, 2])
            behind = vec3()
            transmittance_behind = scalar(1.0)
            for back in range(rgba.shape[1]):
                layer = rgba.shape[1] - 1 - back
                t = grad_rgba[pixel, layer, 3]
                grad_rgba[pixel, layer, 0] = t * g[0]
                grad_rgba[pixel, layer, 1] = t * g[1]
                grad_rgba[pixel, layer, 2] = t * g[2]
                grad_rgba[pixel, layer, 3] = t * (grad_image[pixel, 3] * transmittance_behind - wp.dot(g, behind))
                if layer < layer_count:
                    through = scalar(1.0) - rgba[pixel, layer, 3]
                    color = vec3(rgba[pixel, layer, 0], rgba[pixel, layer, 1], rgba[pixel, layer, 2])
                    behind = color + through * behind
                    transmittance_behind *= through

    return composite_layers_bwd


def _layers_output_like(inputs: Sequence[Any]) -> list[tuple[tuple[int, ...], str]]:
    return [((inputs[0].shape[0], 4), "float")]


def _layers_forward(inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
    rgba = inputs[0]
    launch(_layers_forward_kernel(rgba.dtype), rgba.shape[0], [*inputs, *outputs], rgba.device)


def _layers_backward(inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any]) -> None:
    rgba = inputs[0]
    kernel = _layers_backward_kernel(rgba.dtype)
    launch(kernel, rgba.shape[0], [*inputs, grad_outputs[0], grad_inputs[0]], rgba.device)


_COMPOSITE_LAYERS = Operator(
    name="composite_layers",
    tensors=("rgba", "count"),
    differentiable=("rgba",),
    outputs=("image",),
    output_like=_layers_output_like,
    forward=_layers_forward,
    backward=_layers_backward,
)


@cache
def _fragments_forward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_fragments_fwd(
        span: Span,
        pixels: PIXELS[scalar],
        order: wp.array(dtype=int),
        length: int,
        invalid: wp.array2d(dtype=int),
        image: wp.array(dtype=vec4),
    ):
        base = (span.worker + wp.tid()) * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            beta = pixel_beta(pixels, pixel)
            if not valid_beta(pixels, pixel):
                wp.atomic_min(invalid, span.worker, 1, pixel)
            sort_pixel(pixels, begin, count, order, base)
            running = zero_slab(scalar(0.0))
            running.t = scalar(1.0)
            color = vec3()
            through = scalar(1.0)
            layer = int(0)
            for position in range(count):
                fragment = order[base + position]
                if not valid_fragment(pixels, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                following = load_slab(pixels, fragment, merge_kind)
                step = int(STEP_START)
                if position > 0:
                    step = choose_step(running, following, layer, pixels.max_layers, merge_kind)
                if step == STEP_START:
                    color += through * running.c
                    through *= running.t
                    layer += wp.where(position > 0, 1, 0)
                    running = following
                else:
                    front, back = step_powers(step, running, following, merge_kind, pixels.floor)
                    running = take_step(step, running, following, beta, front, back, merge_kind, mix)
            color += through * running.c
            image[pixel] = vec4(color[0], color[1], color[2], scalar(1.0) - through * running.t)

    return composite_fragments_fwd


@cache
def _fragments_backward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_fragments_bwd(
        span: Span,
        pixels: PIXELS[scalar],
        scratch: SCRATCH[scalar],
        grad_image: wp.array(dtype=vec4),
        grads: GRADIENTS[scalar],
    ):
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            count = pixels.offsets[pixel + 1] - pixels.offsets[pixel]
            beta = pixel_beta(pixels, pixel)
            replay(pixels, pixel, merge_kind, mix, scratch, base)
            g_color = vec3(grad_image[pixel][0], grad_image[pixel][1], grad_image[pixel][2])
            g_opacity = grad_image[pixel][3]
            behind = vec3()
            through_behind = scalar(1.0)
            g = zero_slab(scalar(0.0))
            g_beta = scalar(0.0)
            ends_layer = bool(True)
            for back in range(count):
                at = base + count - 1 - back
                step = scratch.step[at]
                if ends_layer:
                    layer = scratch.running[at]
                    through = scratch.through[at]
                    g = zero_slab(scalar(0.0))
                    g.c = through * g_color
                    g.t = through * (wp.dot(g_color, behind) - g_opacity * through_behind)
                    behind = layer.c + layer.t * behind
                    through_behind *= layer.t
                ends_layer = step == STEP_START
                g_fragment = g
                if step != STEP_START:
                    g_running, g_following, g_step = take_step_adjoint(
                        step,
                        g,
                        scratch.running[at - 1],
                        scratch.fragment[at],
                        beta,
                        scratch.front[at],
                        scratch.back[at],
                        merge_kind,
                        mix,
                        pixels.floor,
                    )
                    g = g_running
                    g_fragment = g_following
                    g_beta += g_step
                store_grad(g_fragment, pixels, scratch.order[at], grads)
            if grads.beta.shape[0] > 0:
                grads.beta[pixel] = g_beta

    return composite_fragments_bwd


@cache
def _over_forward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    """Return the kernel for fragments that do not merge: over is associative, so layers and tail make no difference."""
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_over_fwd(
        span: Span,
        pixels: PIXELS[scalar],
        order: wp.array(dtype=int),
        length: int,
        invalid: wp.array2d(dtype=int),
        image: wp.array(dtype=vec4),
    ):
        base = (span.worker + wp.tid()) * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            if not valid_beta(pixels, pixel):
                wp.atomic_min(invalid, span.worker, 1, pixel)
            sort_pixel(pixels, begin, count, order, base)
            color = vec3()
            through = scalar(1.0)
            for position in range(count):
                fragment = order[base + position]
                if not valid_fragment(pixels, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                rgba = pixels.rgba[fragment]
                color += through * vec3(rgba[0], rgba[1], rgba[2])
                through *= scalar(1.0) - rgba[3]
            image[pixel] = vec4(color[0], color[1], color[2], scalar(1.0) - through)

    return composite_over_fwd


@cache
def _over_backward_kernel(scalar: Any, merge_kind: int, mix: int) -> wp.Kernel:
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_over_bwd(
        span: Span,
        pixels: PIXELS[scalar],
        scratch: SCRATCH[scalar],
        grad_image: wp.array(dtype=vec4),
        grads: GRADIENTS[scalar],
    ):
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = pixels.offsets[pixel]
            count = pixels.offsets[pixel + 1] - begin
            sort_pixel(pixels, begin, count, scratch.order, base)
            through = scalar(1.0)
            for position in range(count):
                scratch.through[base + position] = through
                through *= scalar(1.0) - pixels.rgba[scratch.order[base + position]][3]
            g = grad_image[pixel]
            g_color = vec3(g[0], g[1], g[2])
            behind = vec3()
            through_behind = scalar(1.0)
            for back in range(count):
                at = base + count - 1 - back
                fragment = scratch.order[at]
                rgba = pixels.rgba[fragment]
                t = scratch.through[at]
                if grads.rgba.shape[0] > 0:
                    g_opacity = t * (g[3] * through_behind - wp.dot(g_color, behind))
                    grads.rgba[fragment] = vec4(t * g[0], t * g[1], t * g[2], g_opacity)
                behind = vec3(rgba[0], rgba[1], rgba[2]) + (scalar(1.0) - rgba[3]) * behind
                through_behind *= scalar(1.0) - rgba[3]
                # Nothing else plays a part in over.
                if grads.depth.shape[0] > 0:
                    grads.depth[fragment] = scalar(0.0)
                if grads.thickness.shape[0] > 0:
                    grads.thickness[fragment] = scalar(0.0)
                if grads.opacity_sum.shape[0] > 0:
                    grads.opacity_sum[fragment] = scalar(0.0)
            if grads.beta.shape[0] > 0:
                grads.beta[pixel] = scalar(0.0)

    return composite_over_bwd


def _fragments_output_like(
    inputs: Sequence[Any], max_layers: int, merge: str, mix: str
) -> list[tuple[tuple[int, ...], str]]:
    return [((inputs[3].shape[0] - 1, 4), "float")]


def _fragments_forward(inputs: Sequence[Any], outputs: Sequence[Any], **options: Any) -> None:
    kernel = _over_forward_kernel if options["merge"] == "none" else _fragments_forward_kernel
    Walk(inputs, **options).forward(kernel, [vectors(outputs[0])])


def _fragments_backward(
    inputs: Sequence[Any], grad_outputs: Sequence[Any], grad_inputs: Sequence[Any], **options: Any
) -> None:
    kernel = _over_backward_kernel if options["merge"] == "none" else _fragments_backward_kernel
    Walk(inputs, **options).backward(kernel, [vectors(grad_outputs[0])], grad_inputs)


_COMPOSITE_FRAGMENTS = Operator(
    name="composite_fragments",
    tensors=FRAGMENT_TENSORS,
    differentiable=FRAGMENT_DIFFERENTIABLE,
    outputs=("image",),
    output_like=_fragments_output_like,
    forward=_fragments_forward,
    backward=_fragments_backward,
    options=MERGE_OPTIONS,
)


def composite(
    source: Layers | Fragments,
    beta: Any = None,
    *,
    max_layers: int | None = None,
    merge: Merge | None = None,
    mix: Mix | None = None,
) -> Any:
    """Composite layers, or fragments straight away, front to back by the over operator.

    With fragments the image is that of `composite(resolve(fragments, ...))`, and its gradient too, but no layer is
    stored in between. Differentiable in everything `resolve` is, and in the layers' `rgba`; exact at opacity 1.

    Args:
        source: what to composite. Layers have been merged before, so the options below go with fragments only.
        beta: see `resolve`; default 1.
        max_layers: see `resolve`; default 8.
        merge: see `resolve`; default "smooth".
        mix: see `resolve`; default "opacity".

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4), in the kind and precision of the source's arrays.

    Raises:
        TypeError: an argument is of the wrong type, or options were given together with layers.
        ValueError: an option does not exist, or values are not finite or out of range.
    """
    given = {"beta": beta, "max_layers": max_layers, "merge": merge, "mix": mix}
    if isinstance(source, Layers):
        for name, value in given.items():
            if value is not None:
                raise TypeError(f"{name}: goes with Fragments only, the layers of {type(source).__name__} are merged")
        pixel_count = math.prod(source.shape)
        rgba = source.rgba.reshape((pixel_count, source.max_layers, 4))
        (image,) = apply(_COMPOSITE_LAYERS, (rgba, as_int32(source.count).reshape((pixel_count,))))
        return image.reshape((*source.shape, 4))
    defaults: dict[str, Any] = {"beta": 1.0, "max_layers": 8, "merge": "smooth", "mix": "opacity"}
    chosen = {name: default if given[name] is None else given[name] for name, default in defaults.items()}
    chosen_beta = chosen.pop("beta")
    check_options(**chosen)
    if chosen["merge"] == "exact":
        (image,) = apply_exact(COMPOSITE_EXACT, source, chosen_beta, dimensions=1, mix=chosen["mix"])
    else:
        (image,) = apply(_COMPOSITE_FRAGMENTS, fragment_inputs(source, chosen_beta, dimensions=1), **chosen)
    return image.reshape((*source.shape, 4))
