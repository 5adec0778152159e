"""Supersampling: an image of several samples a pixel, of which each pixel takes the mean (a box filter).

Sampled is what is seen; what is given by pixel, thickness maps and beta, is the same for all samples of a pixel.
"""

from dataclasses import replace
from typing import Any

from warpfrag.arrays.kinds import NUMPY, kind_of
from warpfrag.capture.surfaces import CameraSurfaces
from warpfrag.scene.camera import Camera


def sampling_camera(camera: Camera, samples: int) -> Camera:
    """Return the camera whose pixels are the samples of another's, so many along each edge of a pixel."""
    return camera if samples == 1 else camera.resized((samples * camera.size[0], samples * camera.size[1]))


def sampled_surfaces(surfaces: CameraSurfaces, samples: int) -> CameraSurfaces:
    """Return surfaces as the camera of the samples sees them; points in camera space stay where they are."""
    if samples == 1:
        return surfaces
    maps = surfaces.maps
    if maps is not None:
        count = maps.shape[0]
        maps = by_sample(maps.reshape((count, *surfaces.camera.shape)), samples).reshape((count, -1))
    return replace(surfaces, maps=maps, camera=sampling_camera(surfaces.camera, samples))


def by_sample(values: Any, samples: int) -> Any:
    """Return values by pixel, (…, H, W), as values by sample, (…, samples·H, samples·W); differentiable in torch."""
    kind = kind_of(values)
    if kind is None or samples == 1:
        return values
    if kind.xp is None:
        return kind.asarray(by_sample(kind.to_numpy(values), samples), values)
    *others, height, width = values.shape
    spread = kind.xp.broadcast_to(values[..., :, None, :, None], (*others, height, samples, width, samples))
    return spread.reshape((*others, height * samples, width * samples))


def pixel_means(image: Any, samples: int) -> Any:
    """Return the mean of each pixel's samples: of (samples·H, samples·W, C) an image (H, W, C), NumPy or torch."""
    if samples == 1:
        return image
    height, width, channels = image.shape
    return image.reshape((height // samples, samples, width // samples, samples, channels)).mean((1, 3))


def over_background(image: Any, background: tuple[float, float, float, float]) -> Any:
    """Composite a premultiplied image (H, W, 4), an array or a tensor, over a background of one colour."""
    if not any(background):
        return image
    kind = kind_of(image) or NUMPY
    return image + (1.0 - image[..., 3:]) * kind.asarray(background, image)
