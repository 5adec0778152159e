"""A scene as an image: capture, resolve and composite, in bands of rows where memory is short."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from warpfrag.arrays.legacy import dtype_name, kind_of
from warpfrag.capture.capture import Surfaces, check_scene, fragments_of_rows, place_surfaces
from warpfrag.capture.memory import allowed_memory, fixed_bytes, fragment_bytes, refuse, split_rows
from warpfrag.composite import composite
from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import count_fragments, scan_counts
from warpfrag.resolve.arguments import Merge, Mix, beta_array, check_options
from warpfrag.scene.assemble import assemble
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene


def render(
    scene: Scene,
    camera: Camera | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    beta: Any = None,
    max_layers: int | None = None,
    merge: Merge | None = None,
    mix: Mix | None = None,
    background: bool = True,
    memory_limit: float | None = None,
) -> Any:
    """Render a scene: capture its fragments, merge them into layers, and composite those.

    Differentiable in everything that `capture` and `resolve` are; a gradient in vertices, or in a translation or
    rotation of an object or the camera, moves depths and attributes inside outlines, not the outlines.

    An image that would take more memory than allowed is rendered in bands of rows, with the same pixels to the bit;
    then its gradient is computed band by band, each of them captured once more.

    Args:
        scene: what to render.
        camera: where from; default the scene's.
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays, or
            torch tensors, in which the image is then differentiable.
        beta: see `resolve`; default `parameters["beta"]`, or else the scene's.
        max_layers: see `resolve`; default the scene's `layers`.
        merge: see `resolve`; default the scene's.
        mix: see `resolve`; default the scene's.
        background: whether to composite over the scene's background.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4): a torch tensor if any parameter (or beta) is one, else a
        NumPy array; float64 if any parameter (or beta) is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: a single row would take more memory than allowed.

    Example:
        >>> wf.render(wf.load_scene("scenes/three_spheres.toml"), beta=0.5).shape
        (512, 512, 4)
    """
    camera = check_scene(scene, camera)
    parameters = dict(parameters or {})
    if beta is not None:
        # As a parameter it has its say in the kind and precision of the image.
        parameters["beta"] = beta
    if kind_of(parameters.get("beta")) == "warp":
        raise TypeError("beta: got a wp.array, expected a number, a NumPy array or a torch.Tensor")
    options: dict[str, Any] = {
        "max_layers": scene.layers if max_layers is None else max_layers,
        "merge": scene.merge if merge is None else merge,
        "mix": scene.mix if mix is None else mix,
    }
    check_options(options["merge"], options["mix"], options["max_layers"])
    surfaces = place_surfaces(assemble(scene, parameters, camera=camera), camera)
    beta = _beta_like(parameters.get("beta", scene.beta), surfaces.rgba)
    beta_array(beta, surfaces.rgba, camera.shape)
    window = Window.of(camera)
    with surfaces.stream():
        image = _render_window(surfaces, window, beta, options, memory_limit)
    return over_background(image, scene.background) if background else image


def _render_window(
    surfaces: Surfaces, window: Window, beta: Any, options: Mapping[str, Any], memory_limit: float | None
) -> Any:
    triangles = surfaces.triangles(window)
    allowed = allowed_memory(memory_limit, triangles.device)
    counts = count_fragments(triangles)
    row_counts = counts.numpy().reshape(window.row_count, window.width).sum(axis=1, dtype=np.int64)
    gradient = surfaces.differentiable
    fixed = fixed_bytes(triangles, gradient)
    fragment_size = fragment_bytes(triangles.points.dtype, gradient)
    if fixed + int(row_counts.sum()) * fragment_size <= allowed:
        starts, total = scan_counts(counts)
        return composite(fragments_of_rows(surfaces, triangles, starts, total, True), beta, **options)
    if fixed >= allowed:
        refuse(fixed, allowed, f"{triangles.corners.shape[0]} triangles")
    del triangles

    def render_band(begin: int, end: int, *tensors: Any) -> Any:
        """Render rows from points, colours, thickness, maps and beta: arguments, as torch's checkpoints want them."""
        *arrays, band_beta = tensors
        band_surfaces = replace(surfaces, **dict(zip(("points", "rgba", "thickness", "maps"), arrays, strict=True)))
        # On the way back this runs again, outside of the caller's stream.
        with band_surfaces.stream():
            band_triangles = band_surfaces.triangles(replace(window, first_row=begin, row_count=end - begin))
            starts, total = scan_counts(counts[begin * window.width : end * window.width])
            fragments = fragments_of_rows(band_surfaces, band_triangles, starts, total, True)
            return composite(fragments, _rows(band_beta, begin, end), **options)

    inputs = (surfaces.points, surfaces.rgba, surfaces.thickness, surfaces.maps, beta)
    bands = split_rows(row_counts, 0.0, fragment_size, allowed - fixed)
    if kind_of(surfaces.points) != "torch":
        return np.concatenate([render_band(*band, *inputs) for band in bands])
    import torch
    from torch.utils.checkpoint import checkpoint

    # A graph over all bands would hold all fragments: each band keeps nothing, and is captured again on the way back.
    return torch.cat(
        [checkpoint(render_band, *band, *inputs, use_reentrant=False, preserve_rng_state=False) for band in bands]
    )


def _beta_like(beta: Any, like: Any) -> Any:
    """Return beta in the kind and precision of the image; numbers stay numbers."""
    if kind_of(beta) is None:
        return beta
    if kind_of(like) == "numpy":
        return beta.astype(dtype_name(like), copy=False)
    import torch

    return torch.as_tensor(beta, dtype=like.dtype, device=like.device)


def _rows(beta: Any, begin: int, end: int) -> Any:
    return beta[begin:end] if kind_of(beta) is not None and len(beta.shape) == 2 else beta


def over_background(image: Any, background: tuple[float, float, float, float]) -> Any:
    """Composite a premultiplied image (H, W, 4), an array or a tensor, over a background of one colour."""
    if not any(background):
        return image
    if kind_of(image) == "numpy":
        return image + (1.0 - image[..., 3:]) * np.asarray(background, image.dtype)
    return image + (1.0 - image[..., 3:]) * image.new_tensor(background)
