"""Surfels: opacity falloff, thickness and colours of a point set, fitted to renders of the mesh it is from.

Draws figures/, and writes points.ply, views/ and the numbers of README.md.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
from cloud import load_bunny, render_mesh, sample_points, write_points  # noqa: E402
from discs import Discs  # noqa: E402
from tied import Tied, fit_tied  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.capture.coverage import Coverage  # noqa: E402
from warpfrag.fit import FitParameter, FitResult, Reference, Study, View, load_study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.fit.summary import Figure, Summary, Table  # noqa: E402
from warpfrag.images import write_image  # noqa: E402
from warpfrag.scene.objects import Scene  # noqa: E402

HERE = Path(__file__).parent
COMMAND = "uv run python experiments/fit/surfels/study.py"
POINTS = 2000
# The paper's thickness for points [P(z)].
PAPER = 10.0
# Of the falloff that is set by hand [spacings].
RADIUS = 1.0
# Thicknesses and numbers of points of the curves [P(z)].
MULTIPLES = np.geomspace(1.0, 2e5, 17)
COUNTS = (500, 2000, 8000)
MERGES = {"smooth": "SFM", "order_independent": "OFM", "exact": "exact"}
OPAQUE, FALLOFF = "opaque", "falloff"


@dataclass(frozen=True, eq=False)
class Row:
    """What one way of drawing the points gives.

    Attributes:
        discs: opacity at the start: "opaque", or "falloff" from 1 at the centre.
        fitted: what was fitted, in words.
        merge: how fragments merged, in words.
        thickness: of all [P(z)].
        images: by view.
    """

    discs: str
    fitted: str
    merge: str
    thickness: float
    images: dict[str, np.ndarray]

    def psnr(self, views: Sequence[View]) -> float:
        """Return the mean PSNR of some views [dB]."""
        return float(np.mean([psnr(self.images[view.name], image_of(view)) for view in views]))


@dataclass(frozen=True, eq=False)
class Points:
    """The points as discs, and the study they are fitted by.

    Attributes:
        study: that of study.toml, with references of the size at hand.
        discs: of the points.
    """

    study: Study
    discs: Discs

    @property
    def spacing(self) -> float:
        """Mean distance from a point to the nearest other one [P(z) at the middle]."""
        camera = self.study.scene.camera
        distance = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
        return self.discs.spacing / wf.z_resolution(distance, camera.near, camera.far)

    def scene(self, discs: str, thickness: float, merge: str = "smooth") -> Scene:
        """Return the scene of the discs."""
        opacity = np.ones(len(self.discs.radii)) if discs == OPAQUE else self.discs.falloff(RADIUS)
        return replace(self.study.scene, objects=[self.discs.item(opacity, thickness)], merge=merge)

    def draw(self, discs: str, thickness: float) -> Row:
        """Draw the points with the colours they have."""
        scene = self.scene(discs, thickness)
        images = {v.name: np.asarray(wf.render(replace(scene, camera=v.camera))) for v in self.study.all_views}
        return Row(discs, "nothing", "SFM" if thickness else "plain over", thickness, images)

    def fit(self, discs: str, fitted: str, thickness: float | None = None, merge: str = "smooth") -> tuple[Row, Study]:
        """Fit colours, or colours and opacities.

        Args:
            discs: opacity at the start.
            fitted: keys of the parameters, of "thickness", "color" and "opacity", in words.
            thickness: of all [P(z)]; None fits it as well, from one spacing.
            merge: how fragments merge.
        """
        start = self.spacing if thickness is None else thickness
        parameters: dict[str, FitParameter] = {}
        for key in ("color", "opacity"):
            if key in fitted:
                parameters[f"points.{key}"] = FitParameter(per="vertex")
        if thickness is None:
            parameters["points.thickness"] = replace(self.study.parameters["points.thickness"], start=start)
        scene = self.scene(discs, start, merge)
        study = replace(self.study, scene=scene, parameters=parameters)
        if "color" not in fitted:
            study = replace(study, method=None, steps=None, batch=None, patience=None)
        return row_of(wf.fit(study), discs, fitted, MERGES[merge] if start else "plain over", start), study
