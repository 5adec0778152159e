"""Ways to draw a point set, with fits or without, to be compared with the references of all views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from discs import Discs

import warpfrag as wf
from warpfrag.fit import FitParameter, FitResult, Study, View
from warpfrag.fit.losses import psnr
from warpfrag.scene.names import Merge
from warpfrag.scene.scene import Scene

OPAQUE, FALLOFF = "opaque", "falloff"
# Of the falloff that is set by hand [spacings].
RADIUS = 1.0
# The paper's thickness for points [P(z)].
PAPER = 10.0


@dataclass(frozen=True, eq=False)
class Row:
    """What one way of drawing the points gives.

    Attributes:
        discs: opacity, or where it starts: `OPAQUE`, or `FALLOFF` from 1 at the centre; or another kind of disc.
        fitted: the parameters that were fitted.
        merge: how fragments merged.
        thickness: of all [P(z)].
        images: by view.
        opacity: found for each disc's vertices, (P, V); None where it was not fitted.
    """

    discs: str
    fitted: tuple[str, ...]
    merge: Merge
    thickness: float
    images: dict[str, np.ndarray]
    opacity: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Setting:
    """Points as discs, and the views in which they are to look like the mesh.

    Attributes:
        study: how to fit, with cameras and references.
        discs: of the points, large enough to fall off.
        opaque: of the points, of the size that suits opaque ones.
    """

    study: Study
    discs: Discs
    opaque: Discs

    @property
    def spacing(self) -> float:
        """Spacing of the points [P(z) at the target of the scene's camera]."""
        camera = self.study.scene.camera
        distance = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
        return self.discs.spacing / wf.z_resolution(distance, camera.near, camera.far)

    def views(self, held_out: bool) -> list[View]:
        """Return the views that are held out, or the others."""
        return [view for view in self.study.prepared.views if view.held_out == held_out]

    def scene(self, discs: str, thickness: float, merge: Merge = "smooth") -> Scene:
        """Return the scene of the discs, their thickness in multiples of P(z)."""
        if discs == OPAQUE:
            item = self.opaque.item(np.ones_like(self.opaque.radii), thickness)
        else:
            item = self.discs.item(self.discs.falloff(RADIUS), thickness)
        return replace(self.study.scene, objects=[item], merge=merge)

    def draw(self, discs: str, thickness: float) -> Row:
        """Draw the discs in the colours of the mesh."""
        merge: Merge = "smooth" if thickness else "none"
        scene = self.scene(discs, thickness, merge)
        images = {view.name: np.asarray(wf.render(scene, view.camera)) for view in self.study.prepared.views}
        return Row(discs, (), merge, thickness, images)

    def study_of(self, discs: str, fitted: Sequence[str], thickness: float, merge: Merge = "smooth") -> Study:
        """Return the study that fits some of "color", "opacity" and "thickness", which is or starts at `thickness`."""
        parameters = {f"points.{key}": FitParameter(per="vertex") for key in fitted if key != "thickness"}
        if "thickness" in fitted:
            parameters["points.thickness"] = replace(self.study.parameters["points.thickness"], start=thickness)
        return replace(self.study, scene=self.scene(discs, thickness, merge), parameters=parameters)

    def fit(self, discs: str, fitted: tuple[str, ...], thickness: float, merge: Merge = "smooth") -> Row:
        """Fit as `study_of` says."""
        result = wf.fit(self.study_of(discs, fitted, thickness, merge))
        opacity = result.found.get("points.opacity")
        return Row(
            discs,
            fitted,
            merge,
            float(result.found.get("points.thickness", thickness)),
            images_of(result),
            None if opacity is None else np.asarray(opacity).reshape(-1, len(self.discs.radii)),
        )


def images_of(result: FitResult) -> dict[str, np.ndarray]:
    """Return the images that a fit found, by view."""
    return {view.name: view.after for view in result.views}


def mean_psnr(images: dict[str, np.ndarray], views: Sequence[View]) -> float:
    """Return the mean PSNR of some views [dB], in linear light."""
    return float(np.mean([psnr(images[view.name], reference_of(view)) for view in views]))


def reference_of(view: View) -> np.ndarray:
    """Return the image that a view is to look like."""
    assert view.reference is not None
    assert view.reference.image is not None
    return view.reference.image
