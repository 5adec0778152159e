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
from warpfrag.capture.render import render
from warpfrag.composite import composite
from warpfrag.extras import need
from warpfrag.fit.parameters import Variable
from warpfrag.fit.study import Study, StudyError
from warpfrag.fragments import Fragments
from warpfrag.scene.objects import Scene


class FrozenGeometry:
    """The fragments of a scene as functions of one value per object.

    Args:
        scene: the scene.
        variables: what will be given to `arrays`, all global.
        device: where the tensors are to be.
    """

    def __init__(self, scene: Scene, variables: Sequence[Variable], device: str) -> None:
        torch = need("torch", "torch", "Fitting")
        ones = {v.name: np.ones(v.start.shape, np.float32) for v in variables if v.key != "beta"}
        captured = capture(scene, parameters=ones)
        self.fragments = captured.torch(device)
        self.objects = {
            v.owner: index for v in variables for index, item in enumerate(scene.objects) if item.name == v.owner
        }
        self.masks = {name: self.fragments.object_id == index for name, index in self.objects.items()}
        counts = np.diff(captured.numpy().offsets)
        self.covered = np.flatnonzero(counts)
        pixels = np.repeat(np.arange(counts.size), counts)
        self.members = {name: torch.nonzero(mask).reshape(-1).cpu().numpy() for name, mask in self.masks.items()}
        self.member_pixels = {name: pixels[members] for name, members in self.members.items()}

    def scale(self, owner: str, values: Mapping[str, Any]) -> Any:
        """Return what an object's captured rgba is multiplied with, (4,): (colour·opacity, opacity)."""
        import torch

        one = self.fragments.rgba.new_ones(())
        opacity = values.get(f"{owner}.opacity", one)
        color = values.get(f"{owner}.color", one.expand(3))
        return torch.cat([color * opacity, opacity.reshape(1)])

    def arrays(self, values: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return rgba (F, 4) and thickness (F,), differentiable in the values (tensors)."""
        import torch

        rgba, thickness = self.fragments.rgba, self.fragments.thickness
        # Selected by masks, not gathered by index: the gradient is then a plain sum, the same bits every time.
        for owner, mask in self.masks.items():
            if f"{owner}.opacity" in values or f"{owner}.color" in values:
                rgba = torch.where(mask[:, None], rgba * self.scale(owner, values), rgba)
            if f"{owner}.thickness" in values:
                thickness = torch.where(mask, thickness * values[f"{owner}.thickness"], thickness)
        return rgba, thickness

    def with_arrays(self, rgba: Any, thickness: Any) -> Fragments:
        """Return the fragments with other colours and thicknesses."""
        return replace(self.fragments, rgba=rgba, thickness=thickness)


class Problem:
    """What a study compares: images for parameter values, and the reference.

    Args:
        study: the study.

    Raises:
        StudyError: the reference image has another size than the camera.
    """

    def __init__(self, study: Study) -> None:
        torch = need("torch", "torch", "Fitting")
        self.study, self.scene = study, study.scene
        self.torch = torch
        try:
            self.device = torch.device(study.device)
            torch.zeros(1, device=self.device)
        except (RuntimeError, AssertionError) as error:
            raise StudyError(
                f"device: found {study.device!r}, which torch cannot use ({str(error).splitlines()[0]})"
            ) from None
        self.reference = reference_image(study)
        self.channels = self.reference.shape[2]
        self.background = np.asarray(self.scene.background, np.float32)
        self.frozen = FrozenGeometry(self.scene, study.variables, study.device) if study.is_global else None

    def values(self, coordinates: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters for a vector of a method's coordinates."""
        values, first = {}, 0
        for variable in self.study.variables:
            last = first + variable.start.size
            values[variable.name] = variable.outward(coordinates[first:last].reshape(variable.start.shape))
            first = last
        return values

    def start(self) -> np.ndarray:
        """Return the start as a vector of a method's coordinates, float64."""
        return np.concatenate([variable.inward(variable.start).reshape(-1) for variable in self.study.variables])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the vector."""
        spans = [(variable.span, variable.start.size) for variable in self.study.variables]
        return tuple(np.concatenate([np.full(count, span[side]) for span, count in spans]) for side in (0, 1))  # type: ignore[return-value]

    def tensors(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values as float32 tensors on the study's device; tensors keep their gradient."""
        return {
            name: value.float()
            if isinstance(value, self.torch.Tensor)
            else self.torch.as_tensor(np.asarray(value, np.float32), device=self.device)
            for name, value in values.items()
        }

    def over_background(self, image: Any) -> Any:
        """Return a premultiplied image, an array or a tensor, over the scene's background."""
        if not self.background.any():
            return image
        ground = self.background
        if isinstance(image, self.torch.Tensor):
            ground = self.torch.as_tensor(ground, device=image.device)
        return image + (1.0 - image[..., 3:]) * ground

    def composite(self, fragments: Fragments, beta: Any) -> Any:
        """Composite fragments as the scene says, without its background."""
        scene = self.scene
        return composite(fragments, beta, max_layers=scene.layers, merge=scene.merge, mix=scene.mix)  # type: ignore[arg-type]

    def image(self, values: Mapping[str, Any]) -> Any:
        """Return the image for parameter values, (H, W, 4), differentiable in those that are tensors."""
        tensors = self.tensors(values)
        if self.frozen is None:
            return render(self.scene, parameters=tensors)
        fragments = self.frozen.with_arrays(*self.frozen.arrays(tensors))
        return self.over_background(self.composite(fragments, tensors.get("beta", float(self.scene.beta))))

    def residual(self, image: Any) -> Any:
        """Return image minus reference, (H, W, C), an array or a tensor."""
        reference: Any = self.reference
        if isinstance(image, self.torch.Tensor):
            reference = self.torch.as_tensor(reference, device=image.device)
        return image[..., : self.channels] - reference


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
    image = np.asarray(render(fine, parameters=dict(reference.true or {})))
    if samples > 1:
        image = image.reshape(height, samples, width, samples, 4).mean(axis=(1, 3), dtype=np.float64)
    return np.ascontiguousarray(image, np.float32)
