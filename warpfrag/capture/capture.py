"""A scene as fragments: what each pixel sees (its `Coverage`), shaded."""

from collections.abc import Mapping
from typing import Any

from warpfrag.capture.coverage import find_coverage
from warpfrag.capture.surfaces import check_scene, surfaces_of
from warpfrag.errors import is_whole
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.scene.camera import Camera
from warpfrag.scene.scene import Scene


def capture(
    scene: Scene,
    camera: Camera | None = None,
    sort: bool = True,
    *,
    parameters: Mapping[str, Any] | None = None,
    rows: tuple[int, int] | None = None,
    memory_limit: float | None = None,
) -> Fragments:
    """Capture every surface that a pixel's ray meets as a fragment (the dynamic fragment buffer).

    A triangle covers a pixel if the pixel's centre lies in its projection: by the top-left rule on edges, from both
    sides, between the near and far planes. Differentiable in vertices, translations and rotations of objects and
    camera, colour, opacity and thickness; which pixels a triangle covers, the order of the fragments, the texels that a
    lookup takes and the baked Lambert factors are held fixed: a gradient in vertices or poses moves depths and
    attributes inside outlines, not the outlines.

    Args:
        scene: what to capture.
        camera: where from; default the scene's.
        sort: order of a pixel's fragments: by (depth, object, primitive), or as submitted, by (object, primitive).
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays, or
            torch tensors, in which the fragments are then differentiable. `"thickness"` is that of all objects without
            a value of their own here. `"beta"` is not used here.
        rows: capture only these rows [begin, end) of the image; default all.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.

    Returns:
        Fragments of shape (H, W), or (end - begin, W), with object and primitive ids; torch tensors if any parameter is
        one, else NumPy arrays; float64 if any parameter is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: there would be more fragments than the limit allows; nothing has been stored yet.

    Example:
        >>> wf.capture(wf.load_scene("scenes/three_spheres.toml")).shape
        (512, 512)
    """
    camera = check_scene(scene, camera)
    window = Window.of(camera, _check_rows(rows, camera))
    surfaces = surfaces_of(scene, camera, parameters)
    with surfaces.in_order():
        coverage = find_coverage(scene, camera, surfaces, window, sort=sort, memory_limit=memory_limit)
        return coverage.shade_surfaces(surfaces, moved=False)


def _check_rows(rows: Any, camera: Camera) -> tuple[int, int]:
    height = camera.shape[0]
    if rows is None:
        return 0, height
    begin, end = rows
    if not all(map(is_whole, (begin, end))) or not 0 <= begin <= end <= height:
        raise ValueError(f"rows: got {rows!r}, expected whole numbers (begin, end) with 0 <= begin <= end <= {height}")
    return int(begin), int(end)
