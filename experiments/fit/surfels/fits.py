"""Ways to draw a point set, with fits or without, each compared with the references of all views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from discs import Discs

import warpfrag as wf
from warpfrag.capture.coverage import Coverage
from warpfrag.fit import FitParameter, Study, View
from warpfrag.fit.losses import psnr
from warpfrag.scene.camera import Camera
from warpfrag.scene.objects import Scene

OPAQUE, FALLOFF = "opaque", "falloff"
# Of the falloff that is set by hand [spacings].
RADIUS = 1.0
MERGES = {"none": "plain over", "smooth": "SFM", "order_independent": "OFM", "exact": "exact"}


@dataclass(frozen=True, eq=False)
class Row:
    """What one way of drawing the points gives.

    Attributes:
        discs: opacity, or where it starts: "opaque", or "falloff" from 1 at the centre.
        fitted: keys of the parameters that were fitted.
        merge: how fragments merged.
        thickness: of all [P(z)].
        images: by view.
        opacity: of each disc's vertices, (P, V); None where it was not fitted.
    """

    discs: str
    fitted: tuple[str, ...]
    merge: str
    thickness: float
    images: dict[str, np.ndarray]
    opacity: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Setting:
    """Points as discs, and the views they are to look right in.

    Attributes:
        study: how to fit, with cameras and references.
        discs: of the points.
    """

    study: Study
    discs: Discs

    @property
    def spacing(self) -> float:
        """Spacing of the points, in multiples of P(z) where the cameras look at."""
        camera = self.study.scene.camera
        distance = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
        return self.discs.spacing / wf.z_resolution(distance, camera.near, camera.far)

    @property
    def held_out(self) -> list[View]:
        """The views that are not fitted."""
        return [view for view in self.study.all_views if view.held_out]

    def scene(self, discs: str, thickness: float, merge: str) -> Scene:
        """Return the scene of the discs, their thickness in multiples of P(z)."""
        opacity = np.ones_like(self.discs.radii) if discs == OPAQUE else self.discs.falloff(RADIUS)
        # merge is one of MERGES.
        return replace(self.study.scene, objects=[self.discs.item(opacity, thickness)], merge=merge)  # type: ignore[arg-type]

    def draw(self, discs: str, thickness: float) -> Row:
        """Draw the points with the mesh's colours."""
        merge = "smooth" if thickness else "none"
        scene = self.scene(discs, thickness, merge)
        images = {v.name: np.asarray(wf.render(scene, v.camera)) for v in self.study.all_views}
        return Row(discs, (), merge, thickness, images)

    def study_of(self, discs: str, fitted: tuple[str, ...], thickness: float, merge: str = "smooth") -> Study:
        """Return the study that fits some of "color", "opacity" and "thickness", which is or starts at `thickness`."""
        parameters = {f"points.{key}": FitParameter(per="vertex") for key in fitted if key != "thickness"}
        if "thickness" in fitted:
            parameters["points.thickness"] = self.study.parameters["points.thickness"]
        study = replace(self.study, scene=self.scene(discs, thickness, merge), parameters=parameters)
        # One number alone: least squares.
        return study if len(parameters) > 1 or parameters.keys() else study

    def fit(self, discs: str, fitted: tuple[str, ...], thickness: float, merge: str = "smooth") -> Row:
        """Fit as `study_of` says."""
        result = wf.fit(self.study_of(discs, fitted, thickness, merge))
        return row_of()


def mean_psnr(images: dict[str, np.ndarray], views: Sequence[View]) -> float:
    """Return the mean PSNR of some views [dB]."""
    return float(np.mean([psnr(images[view.name], view.reference.image) for view in views]))
