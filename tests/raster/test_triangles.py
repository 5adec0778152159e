"""Triangles as the walk takes them: corners in order, boxes, lists by band."""

from itertools import pairwise

import numpy as np
import warp as wp
from capture_scenes import orthographic, soup

from warpfrag.raster.ray import Window
from warpfrag.raster.triangles import BAND_ROWS, list_by_band, prepare_triangles


def test_corners_are_ordered_by_their_coordinates():
    """The corners of a triangle come by x, then y, then z, so that neighbours see their edge alike."""
    item = soup(0, 30)
    item.vertices[:, 0] = np.round(item.vertices[:, 0])
    faces = np.random.default_rng(0).permuted(item.faces, axis=1)
    points = item.vertices.astype(np.float32)
    window = Window.of(orthographic((20, 20), 2.0))
    prepared = prepare_triangles(wp.array(points, device="cpu"), wp.array(faces, device="cpu"), window)
    corners = prepared.corners.numpy()
    np.testing.assert_array_equal(np.sort(corners, axis=1), np.sort(faces, axis=1))
    for face in corners:
        keys = [tuple(points[vertex]) for vertex in face]
        assert keys == sorted(keys)


def test_boxes_are_listed_in_every_band_that_they_reach():
    """In order of submission, within each band of rows; what covers nothing is in none."""
    rows = int(BAND_ROWS)
    boxes = np.array([[0, 1, 0, 4], [rows - 1, rows + 1, 0, 4], [0, 0, 0, 0], [0, 3 * rows, 0, 1]], np.int32)
    listed, begins = list_by_band(boxes, 3 * rows)
    bands = [listed[begin:end].tolist() for begin, end in pairwise(begins)]
    assert bands == [[0, 1, 3], [1, 3], [3]]
