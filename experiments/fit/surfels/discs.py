"""Discs of points: a centre and rings of vertices, so that opacity may fall off towards the rim."""

from dataclasses import dataclass, field

import numpy as np

from warpfrag.scene.surface import SceneObject
from warpfrag.shapes.surfels import PointSet, spacing, surfels

# Rim of discs that fall off [spacings], and corners of all: those of the library's surfels.
RIM, SEGMENTS = 2.0, 8
RINGS = 2


@dataclass(frozen=True, eq=False)
class Discs:
    """Discs of points; vertices point by point: the centre, then ring by ring.

    Attributes:
        points: with normals and colours.
        rim: distance of the rim from the centre [spacings].
        spacing: mean distance from a point to its nearest neighbour [scene units].
        radii: distance of each of a disc's vertices from its centre [spacings], (V,).
    """

    points: PointSet
    rim: float = RIM
    spacing: float = field(init=False)
    radii: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "spacing", spacing(self.points.points))
        rings = self.rim * np.arange(1, RINGS + 1) / RINGS
        object.__setattr__(self, "radii", np.concatenate([[0.0], np.repeat(rings, SEGMENTS)]))

    def falloff(self, radius: float) -> np.ndarray:
        """Return the opacity of a disc's vertices where it falls off as exp(−½ (r / radius)²), (V,)."""
        return np.exp(-0.5 * (self.radii / radius) ** 2)

    def item(self, opacity: np.ndarray, thickness: float) -> SceneObject:
        """Return all discs as one object.

        Args:
            opacity: of the vertices of each disc, (V,).
            thickness: of all [P(z)].
        """
        assert self.points.color is not None
        rim = surfels(self.points, self.rim, SEGMENTS).vertices.reshape(-1, SEGMENTS, 3)
        centre = self.points.points[:, None]
        rings = [centre + share * (rim - centre) for share in np.arange(1, RINGS + 1) / RINGS]
        vertices = np.concatenate([centre, *rings], axis=1)
        count, size = vertices.shape[:2]
        return SceneObject(
            "points",
            vertices.reshape(-1, 3),
            (size * np.arange(count)[:, None, None] + disc_faces()).reshape(-1, 3),
            color=np.repeat(self.points.color, size, axis=0),
            opacity=np.tile(opacity, count),
            thickness=thickness,
            thickness_unit="P",
        )


def disc_faces() -> np.ndarray:
    """Return the triangles of one disc: a fan around the centre, then two for each side of each further ring."""
    one = np.arange(SEGMENTS)
    two = (one + 1) % SEGMENTS
    faces = [np.stack([np.zeros_like(one), 1 + one, 1 + two], axis=-1)]
    for inner in range(1, 1 + (RINGS - 1) * SEGMENTS, SEGMENTS):
        outer = inner + SEGMENTS
        faces.append(np.stack([inner + one, outer + one, outer + two], axis=-1))
        faces.append(np.stack([inner + one, outer + two, inner + two], axis=-1))
    return np.concatenate(faces)
