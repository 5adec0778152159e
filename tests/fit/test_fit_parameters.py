"""Fitted parameters: coordinates and bounds."""

import numpy as np
from small_scene import spheres

from warpfrag.fit import FitParameter, Reference, Study


def test_coordinates_go_there_and_back():
    """A value survives the way into a method's coordinates and back, and bounds are kept to the bit."""
    study = Study(
        spheres(), Reference(true={}), {"red.thickness": FitParameter(0.3, 0.1, 0.7), "red.vertices": FitParameter()}
    )
    thickness, vertices = study.prepared.parameters
    for variable in (thickness, vertices):
        np.testing.assert_allclose(
            variable.to_value(variable.to_coordinate(variable.start)), variable.start, rtol=1e-12
        )
    low, high = thickness.coordinate_bounds
    assert thickness.to_value(np.array(low - 1e-15)) == 0.1
    assert thickness.to_value(np.array(high + 1.0)) == 0.7
