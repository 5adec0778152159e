"""Compositing: layers, or fragments straight away, to an image.

    C = sum_i T_i C_i,   A = 1 - prod_i (1 - A_i),   T_i = prod_{j < i} (1 - A_j)   (premultiplied, front to back)

On the way back the colour B_i behind layer i is carried along instead of being divided out:

    dL/dC_i = T_i g,   dL/d(1 - A_i) = T_i (g . B_i - g_A T_behind),   B_{i-1} = C_i + (1 - A_i) B_i

so opaque layers have exact gradients. Everything is differentiable; the fused version holds fixed what `resolve` does.
"""

import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.apply import apply
from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.launch import Span, launch, worker_count
from warpfrag.arrays.operators import Input, Operator, Output
from warpfrag.arrays.precisions import kernels
from warpfrag.fragments import Fragments, Layers, as_int32
from warpfrag.resolve.exact.exact import ExactOptions, exact_backward, exact_forward, exact_inputs
from warpfrag.resolve.options import MERGE_INPUTS, MergeOptions, check_options, merge_inputs
from warpfrag.resolve.pixel import Replay, pixel_beta, sort_pixel, valid_beta
from warpfrag.resolve.sinks import IMAGE, ImageArrays
from warpfrag.resolve.walk import ingredients, resolve_bwd, resolve_fwd, walk_backward, walk_forward
from warpfrag.scene.names import Merge, Mix
from warpfrag.slabs.lists import NO_FRAGMENT, FragmentGradients, FragmentLists, no_invalid, valid_fragment

wp.set_module_options({"enable_backward": False})

# A resolved layer's opacity may be above 1 by rounding.
MOST_OPACITY = wp.constant(1.0 + 1e-5)

IMAGE_OUTPUT = (Output("image", "P 4"),)


@kernels
def composite_layers_fwd(number: Any) -> Any:
    """Return the kernel that composites layers."""
    vec3, vec4 = wp.types.vector(3, number), wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array2d(dtype=vec4),
        count: wp.array(dtype=int),
        invalid: wp.array2d(dtype=int),
        image: wp.array(dtype=vec4),
    ):
        """Composite layers.

        Args:
            span: pixels.
            rgba: the layers, (P, M).
            count: how many of them each pixel has, (P,).
            invalid: output: by thread the lowest pixel with values out of range, (threads, 2).
            image: output, (P,).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            through = number(1.0)
            color = vec3()
            for layer in range(wp.clamp(count[pixel], 0, rgba.shape[1])):
                own = rgba[pixel, layer]
                # Zero times everything: one NaN or infinity makes the sum NaN.
                nothing = number(0.0) * (own[0] + own[1] + own[2])
                if not (nothing == number(0.0) and own[3] >= number(0.0) and own[3] <= number(MOST_OPACITY)):
                    wp.atomic_min(invalid, span.worker, 0, pixel)
                color += through * vec3(own[0], own[1], own[2])
                through *= number(1.0) - own[3]
            image[pixel] = vec4(color[0], color[1], color[2], number(1.0) - through)

    return kernel


@kernels
def composite_layers_bwd(number: Any) -> Any:
    """Return the kernel of the gradient of composited layers."""
    vec3, vec4 = wp.types.vector(3, number), wp.types.vector(4, number)

    def kernel(
        span: Span,
        rgba: wp.array2d(dtype=vec4),
        count: wp.array(dtype=int),
        grad_image: wp.array(dtype=vec4),
        grad_rgba: wp.array2d(dtype=vec4),
    ):
        """Take the gradient of an image back to its layers.

        Args:
            span: pixels.
            rgba: the layers, (P, M).
            count: how many of them each pixel has, (P,).
            grad_image: gradient of the image, (P,).
            grad_rgba: output: gradient of the layers, (P, M).
        """
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            layer_count = wp.clamp(count[pixel], 0, rgba.shape[1])
            # The transmittance up to each layer waits where its opacity's gradient will be.
            through = number(1.0)
            for layer in range(rgba.shape[1]):
                seen = wp.where(layer < layer_count, through, number(0.0))
                grad_rgba[pixel, layer] = vec4(seen, seen, seen, seen)
                through *= number(1.0) - rgba[pixel, layer][3]
            g = grad_image[pixel]
            behind = vec3()
            through_behind = number(1.0)
            for back in range(rgba.shape[1]):
                layer = rgba.shape[1] - 1 - back
                t = grad_rgba[pixel, layer][3]
                g_opacity = t * (g[3] * through_behind - wp.dot(vec3(g[0], g[1], g[2]), behind))
                grad_rgba[pixel, layer] = vec4(t * g[0], t * g[1], t * g[2], g_opacity)
                if layer < layer_count:
                    own = rgba[pixel, layer]
                    behind = vec3(own[0], own[1], own[2]) + (number(1.0) - own[3]) * behind
                    through_behind *= number(1.0) - own[3]

    return kernel


def _layers_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: Any) -> None:
    rgba, device = inputs.rgba, inputs.rgba.device
    rows = worker_count(rgba.shape[0], device, 0)
    invalid = no_invalid(rows, device)
    arguments = [as_vectors(rgba), inputs.count, invalid, as_vectors(outputs.image)]
    launch(composite_layers_fwd(rgba.dtype), rgba.shape[0], arguments, device, rows)
    pixel = int(invalid.numpy()[:, 0].min())
    if pixel != NO_FRAGMENT:
        found = rgba.numpy()[pixel, : int(inputs.count.numpy()[pixel])].tolist()
        raise ValueError(f"layers: got rgba {found} in pixel {pixel}, expected finite values, opacity from 0 to 1")


def _layers_backward(inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: Any) -> None:
    rgba = inputs.rgba
    arguments = [as_vectors(rgba), inputs.count, as_vectors(grads.image), as_vectors(targets.rgba)]
    launch(composite_layers_bwd(rgba.dtype), rgba.shape[0], arguments, rgba.device)


COMPOSITE_LAYERS = Operator(
    "composite_layers",
    (Input("rgba", "P M 4", gradient=True), Input("count", "P", "int")),
    IMAGE_OUTPUT,
    _layers_forward,
    _layers_backward,
)


@kernels
def composite_over_fwd(number: Any) -> Any:
    """Return the kernel for fragments that do not merge: over is associative, so layers and tail make no difference."""
    vec3, vec4 = wp.types.vector(3, number), wp.types.vector(4, number)

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        order: wp.array(dtype=int),
        length: int,
        invalid: wp.array2d(dtype=int),
        out: ImageArrays[number],
    ):
        """Composite fragments; see `resolve_fwd`.

        Args:
            span: pixels.
            lists: their fragments.
            order: scratch memory, `length` for each thread.
            length: of a thread's row.
            invalid: output: what `no_invalid` says, (threads, 2).
            out: output: the image.
        """
        base = (span.worker + wp.tid()) * length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            count = lists.offsets[pixel + 1] - begin
            if not valid_beta(pixel_beta(lists, pixel)):
                wp.atomic_min(invalid, span.worker, 1, pixel)
            sort_pixel(lists, begin, count, order, base)
            color = vec3()
            through = number(1.0)
            for position in range(count):
                fragment = order[base + position]
                if not valid_fragment(lists, fragment):
                    wp.atomic_min(invalid, span.worker, 0, fragment)
                rgba = lists.rgba[fragment]
                color += through * vec3(rgba[0], rgba[1], rgba[2])
                through *= number(1.0) - rgba[3]
            out.image[pixel] = vec4(color[0], color[1], color[2], number(1.0) - through)

    return kernel


@kernels
def composite_over_bwd(number: Any) -> Any:
    """Return the kernel of the gradient of fragments that do not merge."""
    vec3, vec4 = wp.types.vector(3, number), wp.types.vector(4, number)

    def kernel(
        span: Span,
        lists: FragmentLists[number],
        scratch: Replay[number],
        grad_out: ImageArrays[number],
        grads: FragmentGradients[number],
    ):
        """Take the gradient back through pixels; see `resolve_bwd`.

        Args:
            span: pixels.
            lists: their fragments.
            scratch: scratch memory, a row for each thread.
            grad_out: gradient of the image.
            grads: output: gradients of the fragments, and of beta by pixel, (P,).
        """
        base = (span.worker + wp.tid()) * scratch.length
        for pixel in range(span.begin + wp.tid(), span.end, span.stride):
            begin = lists.offsets[pixel]
            count = lists.offsets[pixel + 1] - begin
            sort_pixel(lists, begin, count, scratch.order, base)
            through = number(1.0)
            for position in range(count):
                scratch.through[base + position] = through
                through *= number(1.0) - lists.rgba[scratch.order[base + position]][3]
            g = grad_out.image[pixel]
            g_color = vec3(g[0], g[1], g[2])
            behind = vec3()
            through_behind = number(1.0)
            for back in range(count):
                at = base + count - 1 - back
                fragment = scratch.order[at]
                rgba = lists.rgba[fragment]
                t = scratch.through[at]
                if grads.rgba.shape[0] > 0:
                    g_opacity = t * (g[3] * through_behind - wp.dot(g_color, behind))
                    grads.rgba[fragment] = vec4(t * g[0], t * g[1], t * g[2], g_opacity)
                behind = vec3(rgba[0], rgba[1], rgba[2]) + (number(1.0) - rgba[3]) * behind
                through_behind *= number(1.0) - rgba[3]
                # Nothing else plays a part in over.
                if grads.depth.shape[0] > 0:
                    grads.depth[fragment] = number(0.0)
                if grads.thickness.shape[0] > 0:
                    grads.thickness[fragment] = number(0.0)
                if grads.opacity_sum.shape[0] > 0:
                    grads.opacity_sum[fragment] = number(0.0)
            if grads.beta.shape[0] > 0:
                grads.beta[pixel] = number(0.0)

    return kernel


def _fragments_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: MergeOptions) -> None:
    number = inputs.rgba.dtype
    over = options.merge == "none"
    kernel = composite_over_fwd(number) if over else resolve_fwd(*ingredients(inputs, options), IMAGE)
    walk_forward(kernel, inputs, options, IMAGE.fill(outputs, number))


def _fragments_backward(
    inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: MergeOptions
) -> None:
    number = inputs.rgba.dtype
    over = options.merge == "none"
    kernel = composite_over_bwd(number) if over else resolve_bwd(*ingredients(inputs, options), IMAGE)
    walk_backward(kernel, inputs, options, IMAGE.fill(grads, number), targets)


COMPOSITE = Operator("composite", MERGE_INPUTS, IMAGE_OUTPUT, _fragments_forward, _fragments_backward, MergeOptions)


def _as_layer(image: wp.array) -> SimpleNamespace:
    """Return an image as the only layer of M = 1: over is associative."""
    rgba = image.reshape((image.shape[0], 1, 4))
    return SimpleNamespace(rgba=rgba, depth=None, thickness=None, opacity_sum=None, count=None)


def _exact_forward(inputs: SimpleNamespace, outputs: SimpleNamespace, options: ExactOptions) -> None:
    exact_forward(inputs, _as_layer(outputs.image), options)


def _exact_backward(
    inputs: SimpleNamespace, grads: SimpleNamespace, targets: SimpleNamespace, options: ExactOptions
) -> None:
    exact_backward(inputs, _as_layer(grads.image), targets, options)


COMPOSITE_EXACT = Operator("composite_exact", MERGE_INPUTS, IMAGE_OUTPUT, _exact_forward, _exact_backward, ExactOptions)


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

    Example:
        >>> fragments = wf.capture(wf.load_scene("scenes/three_spheres.toml"))
        >>> wf.composite(fragments, beta=0.5, max_layers=4).shape
        (512, 512, 4)
    """
    given = {"beta": beta, "max_layers": max_layers, "merge": merge, "mix": mix}
    if isinstance(source, Layers):
        for name, value in given.items():
            if value is not None:
                raise TypeError(f"{name}: got it with Layers, expected Fragments (layers are merged already)")
        pixel_count = math.prod(source.shape)
        rgba = source.rgba.reshape((pixel_count, source.max_layers, 4))
        count = as_int32(source.count).reshape((pixel_count,))
        return apply(COMPOSITE_LAYERS, {"rgba": rgba, "count": count}).image.reshape((*source.shape, 4))
    options = check_options(
        "smooth" if merge is None else merge, "opacity" if mix is None else mix, 8 if max_layers is None else max_layers
    )
    beta = 1.0 if beta is None else beta
    if options.merge == "exact":
        alone = MergeOptions(1, options.merge, options.mix)
        image = apply(COMPOSITE_EXACT, *exact_inputs(source, beta, alone, dimensions=1)).image
    else:
        image = apply(COMPOSITE, merge_inputs(source, beta, dimensions=1), options).image
    return image.reshape((*source.shape, 4))
