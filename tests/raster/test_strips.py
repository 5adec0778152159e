"""Strips: how triangles are cut, and which corners a vertex has."""

import numpy as np
import warp as wp

from warpfrag.raster.strips import corners_by_vertex, cut_strips


def test_strips_have_some_thousand_pixels():
    """A triangle is cut into as many rows at a time as make 1024 pixels of its box, at least one; none without rows."""
    boxes = [[0, 64, 0, 64], [5, 6, 0, 9], [0, 0, 0, 0], [3, 10, 0, 5000], [0, 17, 0, 64]]
    strips = cut_strips(wp.array(np.array(boxes, np.int32), device="cpu"))
    np.testing.assert_array_equal(strips.ends.numpy(), np.cumsum([4, 1, 0, 7, 2]))
    np.testing.assert_array_equal(strips.faces.numpy(), np.repeat([0, 1, 3, 4], [4, 1, 7, 2]))
    assert strips.count == 14


def test_corners_of_each_vertex_come_in_the_order_of_triangles():
    """Every corner is in the list of its vertex; a vertex of no triangle has none."""
    corners = np.random.default_rng(0).integers(0, 9, (20, 3)).astype(np.int32)
    corners[corners == 4] = 5
    begins, numbers = (array.numpy() for array in corners_by_vertex(wp.array(corners, device="cpu"), 11))
    for vertex in range(11):
        own = numbers[begins[vertex] : begins[vertex + 1]]
        np.testing.assert_array_equal(own, np.flatnonzero(corners.reshape(-1) == vertex))
    assert begins[4] == begins[5]
