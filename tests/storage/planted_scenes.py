"""Scenes with triangles that coincide, and their fragments as the reference takes and gives them."""

import numpy as np
import reference_storage as reference
from capture_scenes import perspective, pixels_of, scene, soup, surface

from warpfrag.capture.coverage import capture
from warpfrag.scene.surface import SceneObject
from warpfrag.storage.methods import METHODS

OUTPUTS = ("rgba", "depth", "thickness", "offsets", "object_id", "primitive_id")


def planted(seed: int = 0, size=(13, 11), most: int = 40):
    """Return random triangles, of which some come again and again at the same place, 1 to `most` times."""
    random = np.random.default_rng(seed)
    objects: list[SceneObject] = [soup(seed, 10)]
    for number, copies in enumerate((1, 2, 3, 5, 9, most)):
        vertices = random.uniform([-1.2, -1.2, 1.5], [1.2, 1.2, 3.0], (3, 3))
        objects.append(surface(vertices, np.tile([[0, 1, 2]], (copies, 1)), f"planted{number}", opacity=0.3))
    return scene(perspective(size), *objects, soup(seed + 1, 10, name="more"))


def items_of(setting, fragments) -> np.ndarray:
    """Return the number of each fragment's triangle in the whole scene."""
    first = np.cumsum([0, *(len(item.faces) for item in setting.objects)])
    return first[fragments.object_id] + fragments.primitive_id


def pairs_of(setting, fragments) -> list[tuple[int, int]]:
    """Return pixel and triangle of each fragment, in order."""
    return sorted(zip(pixels_of(fragments).tolist(), items_of(setting, fragments).tolist(), strict=True))


def true_pixels(setting, keys_of=None, **options) -> list[list[tuple]]:
    """Return the pairs (triangle, key) of each pixel, in order of submission."""
    fragments = capture(setting, sort=False, **options).numpy()
    keys = fragments.depth if keys_of is None else keys_of(fragments)
    items = items_of(setting, fragments)
    return [
        list(zip(items[begin:end].tolist(), keys[begin:end].tolist(), strict=True))
        for begin, end in zip(fragments.offsets, fragments.offsets[1:], strict=False)
    ]


def expected_pairs(method: str, pixels, **options) -> list[tuple[int, int]]:
    """Return pixel and triangle of what the reference captures, in order."""
    parts = (reference.captured(method, pixel, **options) for pixel in pixels)
    return sorted((number, item) for number, part in enumerate(parts) for item, _ in part)


def assert_same(found, expected) -> None:
    """Compare fragments to the bit."""
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def options_of(method: str, **options):
    """Return those options that a method takes, and its own defaults."""
    return {name: value for name, value in options.items() if name in METHODS[method].options}
