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
from warpfrag.fit.parameters import FittedParameter
from warpfrag.fragments import Fragments
from warpfrag.scene.parameters import COLOR, LOOK_COUNT, OPACITY, THICKNESS
from warpfrag.scene.scene import Scene


class UnitFragments:
    """Fragments with ones in place of the fitted values.

    Args:
        scene: the scene.
        coverage: what each pixel sees.
        fitted: the fitted parameters, all global.
        moved: values of those that move something.
    """

    def __init__(
        self,
        scene: Scene,
        coverage: Coverage,
        fitted: Sequence[FittedParameter],
        moved: Mapping[str, Any] | None = None,
    ) -> None:
        self.fitted = [each for each in fitted if each.kind.look is not None]
        ones = {each.name: np.ones(each.start.shape, np.float32) for each in self.fitted}
        # What the fragments were shaded with.
        self.parameters = {**ones, **(moved or {})}
        self.fragments: Fragments = coverage.shade(self.parameters).numpy()
        self.names = [item.name for item in scene.objects]
        self.objects = np.asarray(self.fragments.object_id)

    def owned(self, each: FittedParameter) -> list[int]:
        """Return the objects that a parameter is a value of; one of the scene, of those without one of their own."""
        own = {other.owner for other in self.fitted if other.kind.look == each.kind.look}
        return [i for i, item in enumerate(self.names) if (item == each.owner if each.owner else item not in own)]

    def scales(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return each object's colour, opacity and thickness, (objects, 5) float32; 1 where not fitted."""
        scales = np.ones((len(self.names), LOOK_COUNT), np.float32)
        for each in self.fitted:
            scales[self.owned(each), each.kind.look] = np.asarray(values.get(each.name, 1.0))
        return scales

    def scaled(self, scales: np.ndarray) -> Fragments:
        """Return the fragments for what `scales` gives."""
        unit = self.fragments
        # Mostly it is thicknesses that are fitted.
        fixed = (scales[:, COLOR.look] == 1.0).all() and (scales[:, OPACITY.look] == 1.0).all()
        colors = unit.rgba if fixed else unit.rgba * premultiplied(scales)[self.objects]
        return replace(unit, rgba=colors, thickness=unit.thickness * scales[self.objects, THICKNESS.look][:, 0])


def premultiplied(scales: np.ndarray) -> np.ndarray:
    """Return the factors of premultiplied colour and opacity, (objects, 4), for what `UnitFragments.scales` gives."""
    color, opacity = scales[:, COLOR.look], scales[:, OPACITY.look]
    return np.concatenate([color * opacity, opacity], axis=1)
