"""Sinks: what becomes of a resolved layer. A kernel that walks through pixels takes one as an ingredient.

A sink is given the layers of a pixel from front to back. `Seen` is what it carries along: forward the image so far, on
the way back the image behind.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpfrag.arrays.kinds import as_vectors
from warpfrag.arrays.precisions import Array, Array2, Number, Vector3, Vector4, in_precisions

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Sink:
    """What becomes of a resolved layer.

    Attributes:
        name: for messages and tests.
        arrays: the structure of its outputs, and of their gradients (empty ones stand for zeros).
        put: `(out, seen, layer, opacity_sum, pixel, number) -> seen` takes a layer, a slab.
        finish: `(out, seen, pixel, count, most)`: the pixel has no more than these.
        cotangent: `(grads, behind, layer, through, pixel, number) -> (g, behind)`: the gradient in a layer's slab,
            given the transmittance of those before it; from back to front.
        names: the outputs.
    """

    name: str
    arrays: Any
    put: wp.Function
    finish: wp.Function
    cotangent: wp.Function
    names: Sequence[str]

    def fill(self, arrays: SimpleNamespace, number: Any) -> Any:
        """Return outputs, or their gradients, as kernels take them; what is None stays empty."""
        filled = self.arrays[number]()
        for name in self.names:
            array = getattr(arrays, name)
            if array is not None:
                setattr(filled, name, as_vectors(array) if name in ("image", "rgba") else array)
        return filled


@in_precisions
class Seen:
    """Colour and transmittance of the layers in front, or behind."""

    color: Vector3
    through: Number


@in_precisions
class ImageArrays:
    """An image: premultiplied colour and opacity, (P,)."""

    image: Array[Vector4]


@in_precisions
class LayerArrays:
    """The layers of all pixels, (P, M) and their number (P,), as in `Layers`."""

    rgba: Array2[Vector4]
    depth: Array2[Number]
    thickness: Array2[Number]
    opacity_sum: Array2[Number]
    count: Array[wp.int32]


@wp.func(inline=True)
def put_in_image(out: Any, seen: Any, layer: Any, opacity_sum: Any, pixel: int, number: int):
    """Composite a layer behind those before."""
    return type(seen)(seen.color + seen.through * layer.color, seen.through * layer.transmittance)


@wp.func(inline=True)
def finish_image(out: Any, seen: Any, pixel: int, count: int, most: int):
    """Write the pixel."""
    color = seen.color
    out.image[pixel] = wp.vector(color[0], color[1], color[2], type(seen.through)(1.0) - seen.through)


@wp.func(inline=True)
def image_cotangent(grads: Any, behind: Any, layer: Any, through: Any, pixel: int, number: int):
    """Return the gradient in a layer: dL/dC = T g, dL/d(1 - A) = T (g . B - g_A T_behind), B the colour behind."""
    g = grads.image[pixel]
    g_color = wp.vector(g[0], g[1], g[2])
    zero = type(through)(0.0)
    g_transmittance = through * (wp.dot(g_color, behind.color) - g[3] * behind.through)
    g_layer = type(layer)(through * g_color, zero, g_transmittance, zero, zero, zero, zero)
    return g_layer, type(behind)(layer.color + layer.transmittance * behind.color, behind.through * layer.transmittance)


@wp.func(inline=True)
def put_layer(out: Any, seen: Any, layer: Any, opacity_sum: Any, pixel: int, number: int):
    """Store a layer."""
    color = layer.color
    out.rgba[pixel, number] = wp.vector(color[0], color[1], color[2], layer.opacity)
    if out.depth.shape[0] > 0:
        out.depth[pixel, number] = layer.back
        out.thickness[pixel, number] = layer.thickness
        out.opacity_sum[pixel, number] = opacity_sum
    return seen


@wp.func(inline=True)
def finish_layers(out: Any, seen: Any, pixel: int, count: int, most: int):
    """Store the number of layers, and zeros past it."""
    zero = type(seen.through)(0.0)
    for unused in range(count, most):
        out.rgba[pixel, unused] = wp.vector(zero, zero, zero, zero)
        if out.depth.shape[0] > 0:
            out.depth[pixel, unused] = zero
            out.thickness[pixel, unused] = zero
            out.opacity_sum[pixel, unused] = zero
    if out.count.shape[0] > 0:
        out.count[pixel] = count


@wp.func(inline=True)
def layer_cotangent(grads: Any, behind: Any, layer: Any, through: Any, pixel: int, number: int):
    """Return the gradient in a layer, whose opacity sum is A w."""
    zero = type(through)(0.0)
    color = wp.vector(zero, zero, zero)
    opacity = zero
    weight = zero
    thickness = zero
    back = zero
    if grads.rgba.shape[0] > 0:
        rgba = grads.rgba[pixel, number]
        color = wp.vector(rgba[0], rgba[1], rgba[2])
        opacity = rgba[3]
    if grads.depth.shape[0] > 0:
        back = grads.depth[pixel, number]
    if grads.thickness.shape[0] > 0:
        thickness = grads.thickness[pixel, number]
    if grads.opacity_sum.shape[0] > 0:
        opacity = opacity + grads.opacity_sum[pixel, number] * layer.weight
        weight = grads.opacity_sum[pixel, number] * layer.opacity
    return type(layer)(color, opacity, zero, zero, weight, thickness, back), behind


IMAGE = Sink("image", ImageArrays, put_in_image, finish_image, image_cotangent, ("image",))
LAYERS = Sink(
    "layers",
    LayerArrays,
    put_layer,
    finish_layers,
    layer_cotangent,
    ("rgba", "depth", "thickness", "opacity_sum", "count"),
)
