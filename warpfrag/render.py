"""A scene as an image: capture, resolve and composite."""

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

from warpfrag.arrays.devices import check_device
from warpfrag.arrays.kinds import kind_of
from warpfrag.arrays.warp_calls import call_with_warp, named_values
from warpfrag.capture.batch import check_views
from warpfrag.renderer import Output, Renderer, check_outputs, joined
from warpfrag.resolving import ResolveMethod, Resolving
from warpfrag.scene.camera import Camera
from warpfrag.scene.parameters import BETA, Bounds
from warpfrag.scene.scene import Scene


def render(
    scene: Scene,
    camera: Camera | Sequence[Camera] | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    output: Output | Sequence[Output] = "color",
    samples: int = 1,
    background: bool = True,
    bounds: Bounds = "clamp",
    memory_limit: float | None = None,
    device: Any = None,
    **resolving: Unpack[Resolving],
) -> Any:
    """Render a scene: capture its fragments, merge them into layers, and composite those.

    Differentiable in everything that `capture` and `resolve` are; a gradient in vertices, or in a translation or
    rotation of an object or the camera, moves depths and attributes inside outlines, not the outlines. A `Renderer`
    renders many images of one scene.

    An image that would take more memory than allowed is rendered in bands of rows, with the same pixels to the bit;
    then its gradient is computed band by band, each of them captured once more.

    Outputs are

    - "color": premultiplied linear colour and opacity, (H, W, 4);
    - "depth": of the foremost surface, that is, of the fragment nearest to the eye whose opacity is above 0: distance
      from the eye along the pixel's ray [scene units], (H, W); 0 where there is none;
    - "normal": unit normal of its triangle, turned towards the eye, in camera space (x right, y down, z forward),
      (H, W, 3); zeros where there is none;
    - "object_id": its object's place among `scene.objects`, int32 (H, W); -1 where there is none;
    - "layers": what fragments are merged into, `Layers`;
    - "count": how many layers that are, int32 (H, W).

    Colour, depth and layers are differentiable; which surface is foremost, and normals, are held fixed.

    Args:
        scene: what to render.
        camera: where from; default the scene's. Several, of one size, give a leading dimension: images (N, H, W, 4).
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays,
            torch tensors or Warp arrays, in which the image is then differentiable (Warp arrays on an active tape,
            which takes torch). With several cameras beta may be one map for each, (N, H, W).
        output: what to render, one of the names above, or several.
        samples: samples along each edge of a pixel, at the middles of its samples × samples parts; the colour is their
            mean (a box filter). Values by pixel, of thickness and beta, are those of the image's pixels, and all
            outputs but the colour are those of the pixel's centre.
        background: whether to composite over the scene's background.
        bounds: what becomes of parameters out of their range: "clamp" puts them on its end, with a gradient that leads
            back in but not farther out; "error" refuses them.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.
        device: where to compute, "cpu", "cuda" or "cuda:<number>"; default that of the arrays among the parameters, or
            else "cpu".
        resolving: how fragments become layers: `resolve`, `beta`, `max_layers`, `merge`, `mix`, see `Resolving`;
            default the scene's.

    Returns:
        The output, or a dict of several by name: torch tensors or Warp arrays if any parameter (or beta) is one, else
        NumPy arrays; float64 if any parameter (or beta) is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: a single row would take more memory than allowed.

    Example:
        >>> scene = wf.load_scene("scenes/three_spheres.toml")
        >>> wf.render(scene, beta=0.5, samples=2).shape
        (512, 512, 4)
        >>> wf.render(scene, output=("depth", "object_id"))["object_id"][256, 256]
        1
    """
    views, several = check_views(scene, camera)
    wanted, method = check_outputs(output), ResolveMethod.of(scene, resolving)
    options = {"samples": samples, "background": background, "bounds": bounds, "memory_limit": memory_limit}
    values = named_values(parameters, beta=method.beta)

    def draw(given: Mapping[str, Any], place: str | None) -> dict[str, Any]:
        results = []
        for index, view in enumerate(views):
            own = dict(given)
            if several and BETA.key in given:
                own[BETA.key] = _beta_of_view(given[BETA.key], index, len(views))
            renderer = Renderer(scene, view, device=place, **options, **method.options)  # type: ignore[arg-type]
            results.append(list(renderer.draw(own, wanted, place).values()))
        parts = joined(results, "stack") if several else results[0]
        return dict(zip(wanted, parts, strict=True))

    found = call_with_warp(draw, values, scene.value_shapes(), check_device(device))
    return found[output] if isinstance(output, str) else found


def _beta_of_view(beta: Any, index: int, count: int) -> Any:
    """Return the part of a beta that is one of several cameras'."""
    stacked = kind_of(beta) is not None and len(beta.shape) == 3 and beta.shape[0] == count
    return beta[index] if stacked else beta
