"""The image as a function of the fitted parameters, and the reference it is compared with.

While only beta and one thickness, opacity or colour per object change, coverage, depth and interpolated attributes
stay: the scene is captured once, with ones in place of the fitted values. A fragment's thickness is then that of the
capture (1, or P(z)) times the object's value, its premultiplied colour that of the capture times colour and opacity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warpfrag.capture.capture import capture
from warpfrag.capture.kbuffer import capture_kbuffer
from warpfrag.capture.render import render
from warpfrag.composite import composite
from warpfrag.fit.parameters import Variable
from warpfrag.fit.study import Study, StudyError
from warpfrag.fragments import Fragments
from warpfrag.interop.operator import kind_of
from warpfrag.resolve.kbuffer import kbuffer
from warpfrag.scene.objects import Scene


class FrozenGeometry:
    """The fragments of a scene as functions of one value per object.

    Args:
        scene: the scene.
        variables: what will be given to `scaled`, all global.
        sort: whether the fragments are to be sorted by depth, or in order of submission.
    """

    def __init__(self, scene: Scene, variables: Sequence[Variable], sort: bool = True) -> None:
        ones = {v.name: np.ones(v.start.shape, np.float32) for v in variables if v.key != "beta"}
        self.fragments: Fragments = capture(scene, parameters=ones, sort=sort).numpy()
        owners = {variable.owner for variable in variables}
        self.masks: dict[str, Any] = {
            item.name: self.fragments.object_id == index
            for index, item in enumerate(scene.objects)
            if item.name in owners
        }

    def torch(self, device: Any) -> "FrozenGeometry":
        """Return the same with torch tensors on a device."""
        import torch

        other = object.__new__(FrozenGeometry)
        other.fragments = self.fragments.torch(device)
        other.masks = {name: torch.as_tensor(mask, device=device) for name, mask in self.masks.items()}
        return other

    def scaled(self, values: Mapping[str, Any]) -> Fragments:
        """Return the fragments for parameter values, of the kind of the fragments; tensors keep their gradient."""
        xp = _namespace(self.fragments.rgba)
        rgba, thickness = self.fragments.rgba, self.fragments.thickness
        # Selected by masks, not gathered by index: the gradient is then a plain sum, the same bits every time.
        for owner, mask in self.masks.items():
            opacity, color = values.get(f"{owner}.opacity"), values.get(f"{owner}.color")
            if color is not None:
                whole = xp.concatenate([color, xp.ones_like(color[:1])])
                rgba = xp.where(mask[:, None], rgba * whole, rgba)
            if opacity is not None:
                rgba = xp.where(mask[:, None], rgba * opacity, rgba)
            if f"{owner}.thickness" in values:
                thickness = xp.where(mask, thickness * values[f"{owner}.thickness"], thickness)
        return replace(self.fragments, rgba=rgba, thickness=thickness)


class Problem:
    """What a study compares: images for parameter values, and the reference.

    Args:
        study: the study.

    Raises:
        StudyError: the reference image has another size than the camera.
    """

    def __init__(self, study: Study) -> None:
        self.study, self.scene = study, study.scene
        self.reference = reference_image(study)
        self.channels = self.reference.shape[2]
        self.background = np.asarray(self.scene.background, np.float32)
        sort = study.resolve == "sorted"
        self.frozen = FrozenGeometry(self.scene, study.variables, sort) if study.is_global else None

    def values(self, coordinates: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters for a vector of a method's coordinates."""
        values, first = {}, 0
        for variable in self.study.variables:
            last = first + variable.start.size
            values[variable.name] = np.asarray(variable.outward(coordinates[first:last].reshape(variable.start.shape)))
            first = last
        return values

    def start(self) -> np.ndarray:
        """Return the start as a vector of a method's coordinates, float64."""
        return np.concatenate([variable.inward(variable.start).reshape(-1) for variable in self.study.variables])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the vector."""
        spans = [np.tile(variable.span, (variable.start.size, 1)) for variable in self.study.variables]
        lower, upper = np.concatenate(spans).T
        return lower, upper

    def over_background(self, image: Any) -> Any:
        """Return a premultiplied image, an array or a tensor, over the scene's background."""
        if not self.background.any():
            return image
        return image + (1.0 - image[..., 3:]) * _like(self.background, image)

    def composite(self, fragments: Fragments, beta: Any) -> Any:
        """Composite fragments as the scene says, without its background."""
        scene = self.scene
        if self.study.resolve == "kbuffer":
            return composite(kbuffer(fragments, scene.layers, merge=scene.merge))  # type: ignore[arg-type]
        return composite(fragments, beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)

    def image(self, values: Mapping[str, Any], frozen: FrozenGeometry | None = None) -> Any:
        """Return the image for parameter values, (H, W, 4) float32.

        Args:
            values: arrays; or torch tensors, in which the image is then differentiable.
            frozen: the frozen geometry as tensors, if the values are.
        """
        single = {name: _single(value) for name, value in values.items()}
        frozen = frozen or self.frozen
        if frozen is None:
            return render_scene(self.scene, self.study.resolve, single)
        beta = single.get("beta", float(self.scene.beta))
        return self.over_background(self.composite(frozen.scaled(single), beta))

    def residual(self, image: Any) -> Any:
        """Return image minus reference, (H, W, C), an array or a tensor."""
        return image[..., : self.channels] - _like(self.reference, image)


def _namespace(array: Any) -> Any:
    if kind_of(array) == "torch":
        import torch

        return torch
    return np


def _like(array: np.ndarray, image: Any) -> Any:
    xp = _namespace(image)
    return array if xp is np else xp.as_tensor(array, device=image.device)


def _single(value: Any) -> Any:
    return value.float() if kind_of(value) == "torch" else np.asarray(value, np.float32)


def render_scene(scene: Scene, resolve: str, parameters: Mapping[str, Any]) -> Any:
    """Render a scene as `Study.resolve` says."""
    if resolve == "sorted":
        return render(scene, parameters=parameters)
    layers = capture_kbuffer(scene, slots=scene.layers, merge=scene.merge, parameters=parameters)  # type: ignore[arg-type]
    image = composite(layers)
    return image + (1.0 - image[..., 3:]) * _like(np.asarray(scene.background, np.float32), image)


def reference_image(study: Study) -> np.ndarray:
    """Return the image a study approaches, (H, W, 3 or 4) float32.

    Raises:
        StudyError: it has another size than the camera.
    """
    reference, scene = study.reference, study.scene
    height, width = scene.camera.shape
    if reference.image is not None:
        image = np.asarray(reference.image, np.float32)
        if image.ndim != 3 or image.shape[2] not in (3, 4) or not np.isfinite(image).all():
            raise StudyError(
                f"{reference.source}: found shape {image.shape}, expected finite values of shape (H, W, 3 or 4)"
            )
        if image.shape[:2] != (height, width):
            found = f"{image.shape[1]} × {image.shape[0]}"
            raise StudyError(
                f"{reference.source}: found {found} pixels, expected {width} × {height} like the study's camera"
            )
        if image.shape[2] == 4:
            image = image + (1.0 - image[..., 3:]) * np.asarray(scene.background, np.float32)
        return image
    samples = reference.supersampling
    options = {key: getattr(reference, key) or getattr(scene, key) for key in ("merge", "mix", "layers")}
    fine = replace(scene, camera=scene.camera.resized((width * samples, height * samples)), **options)
    image = np.asarray(render_scene(fine, study.resolve, dict(reference.true or {})))
    if samples > 1:
        image = image.reshape(height, samples, width, samples, 4).mean(axis=(1, 3), dtype=np.float64)
    return np.ascontiguousarray(image, np.float32)
