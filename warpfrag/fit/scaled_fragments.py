"""The fragments of a view as functions of few values per object.

While only a thickness, an opacity or a colour per object change, coverage, depth and interpolated attributes stay: the
scene is shaded with ones in place of the fitted values. A fragment's thickness is then that of the shading (1, or P(z))
times the object's value, its premultiplied colour that of the shading times colour and opacity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warpfrag.capture.coverage import Coverage
from warpfrag.fit.parameters import Variable
from warpfrag.fragments import Fragments
from warpfrag.scene.scene import Scene


class UnitFragments:
    """Fragments with ones in place of the fitted values.

    Args:
        scene: the scene.
        coverage: what each pixel sees.
        variables: the fitted parameters, all global.
        moved: values of those that move something.
    """

    def __init__(
        self, scene: Scene, coverage: Coverage, variables: Sequence[Variable], moved: Mapping[str, Any] | None = None
    ) -> None:
        self.variables = variables
        ones = {v.name: np.ones(v.start.shape, np.float32) for v in variables if v.key != "beta" and not v.moves}
        # What the fragments were shaded with.
        self.parameters = {**ones, **(moved or {})}
        self.fragments: Fragments = coverage.shade(self.parameters).numpy()
        self.names = [item.name for item in scene.objects]
        self.objects = np.asarray(self.fragments.object_id)

    def owned(self, name: str) -> list[int]:
        """Return the objects that a parameter is a value of; one of the scene, of those without one of their own."""
        owner, _, key = name.rpartition(".")
        own = {v.owner for v in self.variables if v.key == key}
        return [i for i, item in enumerate(self.names) if (item == owner if owner else item not in own)]

    def scales(self, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return each object's colour and opacity, (objects, 4), and thickness, (objects,); 1 where not fitted."""
        rgba, thickness = np.ones((len(self.names), 4), np.float32), np.ones(len(self.names), np.float32)
        for variable in self.variables:
            owned, value = self.owned(variable.name), np.asarray(values.get(variable.name, 1.0))
            if variable.key == "color":
                rgba[owned, :3] = value
            elif variable.key == "opacity":
                rgba[owned, 3] = value
            elif variable.key == "thickness":
                thickness[owned] = value
        return rgba, thickness

    def scaled(self, rgba: np.ndarray, thickness: np.ndarray) -> Fragments:
        """Return the fragments for what `scales` gives."""
        unit = self.fragments
        # Mostly it is thicknesses that are fitted.
        colors = unit.rgba if (rgba == 1.0).all() else unit.rgba * premultiplied(rgba)[self.objects]
        return replace(unit, rgba=colors, thickness=unit.thickness * thickness[self.objects])


def premultiplied(rgba: np.ndarray) -> np.ndarray:
    """Return straight colours and opacities (N, 4) with the colours multiplied by the opacities."""
    return np.concatenate([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], axis=1)
