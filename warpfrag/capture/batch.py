"""Several cameras at once: fragments of each, in one grid with a leading dimension."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from warpfrag.arrays.kinds import common_kind, dtype_name
from warpfrag.capture.surfaces import check_scene
from warpfrag.errors import shorten
from warpfrag.fragments import Fragments
from warpfrag.scene.camera import Camera


def check_views(scene: Any, camera: Any) -> tuple[list[Camera], bool]:
    """Return the cameras to render a scene from, and whether there is a sequence of them, all of one size.

    Raises:
        TypeError: the scene is none, or something else is given for a camera.
        ValueError: the sequence is empty, or sizes differ.
    """
    if isinstance(camera, (str, bytes)) or not isinstance(camera, Sequence):
        return [check_scene(scene, camera)], False
    cameras = list(camera)
    if not cameras:
        raise ValueError("camera: got an empty sequence, expected at least one Camera")
    for index, each in enumerate(cameras):
        if not isinstance(each, Camera):
            raise TypeError(f"camera[{index}]: got {shorten(each)}, expected a Camera")
        if each.size != cameras[0].size:
            sizes = [" × ".join(map(str, one.size)) for one in (each, cameras[0])]
            raise ValueError(f"camera[{index}]: got the size {sizes[0]}, expected {sizes[1]} like the first")
    return [check_scene(scene, each) for each in cameras], True


def stack_fragments(parts: Sequence[Fragments]) -> Fragments:
    """Return the fragments of grids of one shape in one grid with a leading dimension; differentiable in torch.

    Args:
        parts: at least one; NumPy arrays or torch tensors, all with the same arrays.
    """
    first = parts[0]
    kind = common_kind({"rgba": first.rgba})
    joined: dict[str, Any] = {}
    for name in (each.name for each in fields(Fragments) if each.name not in ("offsets", "shape")):
        arrays = [getattr(part, name) for part in parts]
        joined[name] = None if arrays[0] is None else kind.xp.concatenate(arrays)
    begin, offsets = 0, [first.offsets[:1]]
    for part in parts:
        offsets.append(part.offsets[1:] + begin)
        begin += part.count
    index = kind.astype(kind.xp.concatenate(offsets), dtype_name(first.offsets))
    return Fragments(**joined, offsets=index, shape=(len(parts), *first.shape))
