"""How many fragments of a pixel share a depth: counts by hand, with a tolerance, and the picture of them."""

import numpy as np
import pytest
from capture_scenes import perspective, quad, scene

import warpfrag as wf


def pixels(*depths, dtype=np.float32):
    """Fragments of a row of pixels with these depths."""
    return wf.Fragments.from_lists([[(0, 0, 0, 1, z, 0) for z in own] for own in depths], (1, len(depths)), dtype)


def test_largest_group_of_each_pixel():
    """None, one, pairs and triples in any order; C_p counts covered pixels."""
    found = wf.coplanarity(pixels([], [1], [2, 1, 2], [3, 1, 3, 2, 3, 2], [1, 2, 3]))
    np.testing.assert_array_equal(found.counts, [[0, 1, 2, 3, 1]])
    assert found.counts.dtype == np.int32
    assert found.share == 0.5
    assert "share 0.5, up to 3 fragments" in repr(found)


def test_groups_end_with_their_pixel():
    """The last depth of a pixel and the first of the next one are two, even if they are equal."""
    np.testing.assert_array_equal(wf.coplanarity(pixels([1, 2], [2, 3])).counts, [[1, 1]])


@pytest.mark.parametrize(("tolerance", "count"), [(0.0, 1), (0.2, 2), (0.3, 4)])
def test_tolerance(tolerance, count):
    """Fragments belong together if each is near enough to the next, however far the first is from the last."""
    found = wf.coplanarity(pixels([1.0, 1.25, 1.5, 1.625], dtype=np.float64), tolerance)
    assert found.counts.item() == count


def test_scene_of_coincident_squares():
    """Three squares at one depth: all covered pixels are coplanar."""
    setting = scene(perspective((8, 8)), *(quad(2.0, 0.5, name=name) for name in "abc"), quad(3.0, 0.5, name="d"))
    found = wf.coplanarity(wf.capture(setting))
    assert set(np.unique(found.counts)) == {0, 3}
    assert found.share == 1.0
    assert wf.coplanarity(wf.capture(setting).torch()).share == 1.0


def test_map_has_the_colours_of_the_paper():
    """Gray, red, blue, green, …; brown from nine on; nothing where nothing is."""
    found = wf.coplanarity(pixels([], [1], *([1] * count for count in range(2, 12))))
    image = found.map()
    assert image.shape == (1, 12, 4)
    assert image.dtype == np.float32
    assert image[0, 0].tolist() == [0, 0, 0, 0]
    np.testing.assert_allclose(image[0, 1], [0.2159, 0.2159, 0.2159, 1], atol=1e-4)
    expected = {2: [1, 0, 0], 3: [0, 0, 1], 5: [0, 1, 1], 7: [1, 0, 1], 8: [1, 1, 0]}
    for count, color in expected.items():
        assert image[0, count].tolist() == [*color, 1]
    assert image[0, 9].tolist() == image[0, 11].tolist()


def test_nothing_is_covered():
    """No pixel, no share."""
    found = wf.coplanarity(pixels([], []))
    assert found.share == 0.0
    assert not found.map().any()


def test_bad_arguments():
    """Named, with what is expected."""
    with pytest.raises(ValueError, match="tolerance: got -1, expected a number of at least 0"):
        wf.coplanarity(pixels([1]), -1)
    with pytest.raises(TypeError, match="fragments: got list, expected Fragments"):
        wf.coplanarity([1])
