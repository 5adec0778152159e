"""Every method of the papers against plain loops over the true list of fragments of each pixel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference_storage as reference
from capture_scenes import orthographic, perspective, pixels_of, quad, scene
from planted_scenes import assert_same, expected_pairs, items_of, options_of, pairs_of, planted, true_pixels

import warpfrag as wf
from warpfrag.capture.coverage import capture
from warpfrag.scene.visibility import EmptyImageWarning
from warpfrag.storage.methods import METHODS

DEPTH_BITS = [name for name, method in METHODS.items() if "depth_bits" in method.options]
APPROXIMATE = [name for name in METHODS if name not in reference.ROBUST]


@pytest.mark.parametrize("method", reference.ROBUST)
def test_robust_methods_capture_what_the_dynamic_fragment_buffer_does(method):
    """To the bit, where up to 40 triangles coincide, sorted or as submitted."""
    setting = planted()
    expected = capture(setting)
    found = wf.storage.capture(setting, method=method)
    assert_same(found.fragments, expected)
    assert found.robustness == 1.0
    assert found.lost == 0
    assert found.seen == found.captured == expected.count
    assert_same(capture(setting, sort=False, method=method), capture(setting, sort=False))


SHIPPED = ["coplanar_cubes", "sphere_and_cubes", "sphere_pair", "spheres_in_sphere", "three_spheres", "two_cylinders"]


@pytest.mark.parametrize("name", SHIPPED)
def test_robust_methods_on_shipped_scenes(name):
    """All fragments of every scene, by all of them."""
    setting = wf.load_scene(Path(__file__).parents[2] / "scenes" / f"{name}.toml")
    setting = replace(setting, camera=setting.camera.resized((40, 30)))
    expected = capture(setting)
    assert expected.count > 500
    for method in reference.ROBUST:
        assert_same(wf.storage.capture(setting, method=method).fragments, expected)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("slots", [1, 3, 8])
@pytest.mark.parametrize("method", APPROXIMATE)
def test_approximate_methods_capture_what_the_papers_say(method, slots, seed):
    """Exactly the fragments that plain loops find, shaded and sorted as those of every capture."""
    setting = planted(seed)
    options = options_of(method, slots=slots, buckets=slots)
    found = wf.storage.capture(setting, method=method, **options)
    reference_options = {**dict(METHODS[method].defaults), **options}
    assert pairs_of(setting, found.fragments) == expected_pairs(method, true_pixels(setting), **reference_options)
    every = capture(setting)
    kept = np.isin(
        pixels_of(every) * 10**6 + items_of(setting, every),
        pixels_of(found.fragments) * 10**6 + items_of(setting, found.fragments),
    )
    np.testing.assert_array_equal(found.fragments.rgba, every.rgba[kept])
    np.testing.assert_array_equal(found.fragments.depth, every.depth[kept])
    assert found.seen == every.count
    assert found.lost == every.count - found.captured > 0
    assert found.robustness == found.captured / found.seen < 1.0
    assert found.loses


@pytest.mark.parametrize("method", [name for name, each in METHODS.items() if "packed" in each.options])
def test_packed_attributes_make_more_slots(method):
    """Four times as many where fragments of equal depth are peeled, else twice."""
    setting = planted(3)
    found = wf.storage.capture(setting, method=method, slots=2, packed=True)
    assert pairs_of(setting, found.fragments) == expected_pairs(method, true_pixels(setting), slots=2, packed=True)
    assert found.captured > wf.storage.capture(setting, method=method, slots=2).captured


@pytest.mark.parametrize("hazard", [1, 2, 3, 7])
def test_hazards_of_the_kbuffer(hazard):
    """Of each g fragments that read the same state only the last is there in the end."""
    setting = planted(4)
    found = wf.storage.capture(setting, method="kb", slots=5, hazard=hazard)
    assert pairs_of(setting, found.fragments) == expected_pairs("kb", true_pixels(setting), slots=5, hazard=hazard)


@pytest.mark.parametrize("method", DEPTH_BITS)
@pytest.mark.parametrize("bits", [4, 12])
def test_depth_buffers_of_few_bits(method, bits):
    """Depths that round to the same step of a fixed-point buffer count as equal."""
    setting = planted(5)
    camera = setting.camera
    x, y = np.meshgrid(
        np.arange(camera.width) + 0.5 - camera.middle[0], np.arange(camera.shape[0]) + 0.5 - camera.middle[1]
    )
    along = np.sqrt(1.0 + (x / camera.focal) ** 2 + (y / camera.focal) ** 2).reshape(-1)

    def steps(fragments):
        z = fragments.depth / along[pixels_of(fragments)]
        window = camera.far * (z - camera.near) / (z * (camera.far - camera.near))
        return np.floor(window * (2**bits - 1) + 0.5)

    found = wf.storage.capture(setting, method=method, depth_bits=bits, **options_of(method, slots=3, buckets=3))
    pixels = true_pixels(setting, steps)
    options = options_of(method, slots=3)
    assert pairs_of(setting, found.fragments) == expected_pairs(method, pixels, **options)
    if method in ("f2b", "dual", "bun"):
        assert found.captured < wf.storage.capture(setting, method=method).captured


@pytest.mark.parametrize("method", ["f2b", "f2b2", "f2b_2p", "f2b_3p", "f2b_ll", "f2b_fab", "f2b_kb", "dual", "dual_ll",
                                    "dual_fab", "srab", "dfb", "dxdfb", "s_buffer", "fixed_array", "kb"])  # fmt: skip
def test_number_of_passes(method):
    """That of the papers: D layers, n fragments of a pixel, C of equal depth."""
    setting = planted(6)
    options = {"max_passes": None} if method == "srab" else options_of(method, pool=10**6)
    found = wf.storage.capture(setting, method=method, **options)
    assert found.passes == reference.passes(method, true_pixels(setting), **options)
    assert len(found.seconds) == len(found.objects) == found.passes
    assert all(seconds > 0.0 for seconds in found.seconds)


def test_dual_pairs_need_about_half_the_passes():
    """Two pairs an iteration, one from each end."""
    setting = planted(6)
    front, both = (wf.storage.capture(setting, method=method).passes for method in ("f2b_2p", "dual_2p"))
    assert both % 2 == 1
    assert front // 2 <= both < front


@pytest.mark.parametrize("method", [name for name, each in METHODS.items() if "max_passes" in each.options])
def test_fewer_passes_than_needed(method):
    """What has been peeled until then is captured; what is lost is counted."""
    setting = planted(7)
    whole = wf.storage.capture(setting, method=method, **{**options_of(method, slots=2, buckets=1), "max_passes": None})
    found = wf.storage.capture(setting, method=method, **options_of(method, slots=2, buckets=1), max_passes=3)
    assert found.passes == 3 < whole.passes
    assert 0 < found.captured < whole.captured
    assert found.loses.endswith("what is left after the last pass")
    assert set(pairs_of(setting, found.fragments)) < set(pairs_of(setting, whole.fragments))


def test_layers_come_front_to_back():
    """After k passes front-to-back peeling has the k nearest depths."""
    setting = planted(8)
    found = wf.storage.capture(setting, method="f2b", max_passes=2)
    pixels = true_pixels(setting)
    expected = [(n, max(layer)[0]) for n, p in enumerate(pixels) for layer in reference.layers_of(p)[:2]]
    assert pairs_of(setting, found.fragments) == sorted(expected)


@pytest.mark.parametrize("method", [name for name, each in METHODS.items() if "pool" in each.options])
def test_pools_grow_until_all_fits(method):
    """Overflow doubles the pool and repeats the pass; what comes out is the same."""
    setting = planted(9)
    found = wf.storage.capture(setting, method=method, pool=7)
    large = wf.storage.capture(setting, method=method, pool=10**5)
    assert found.passes > large.passes
    assert_same(found.fragments, large.fragments)
    assert found.robustness == 1.0


@pytest.mark.parametrize(("method", "page"), [("linked_list", 1), ("paged_list", 4), ("paged_list", 3), ("bun_ll", 1)])
def test_pools_that_do_not_grow(method, page):
    """What finds no room is lost and counted: what comes first stays, the same for any number of threads."""
    setting = planted(10, size=(13, 37))
    every = capture(setting)
    pool = every.count // 2
    options = {"page": page} if method == "paged_list" else {}
    found = wf.storage.capture(setting, method=method, pool=pool, grow=False, **options)
    assert pairs_of(setting, found.fragments) == sorted(
        reference.pool_keeps(pairs_of(setting, every), setting.camera.width, pool, page)
    )
    assert found.lost == every.count - found.captured > 0
    assert found.loses == "what finds no room in the pool"
    assert "lost (what finds no room in the pool)" in repr(found)


@pytest.mark.parametrize("method", ["f2b_ll", "dual_ll"])
def test_lists_of_layers_need_room_for_a_layer(method):
    """Nodes are used again by the next layer; without enough of them fragments of equal depth are lost."""
    setting = planted(11)
    counts = np.diff(capture(setting).offsets)
    found = wf.storage.capture(setting, method=method, pool=int(counts.sum()) // 2)
    assert found.robustness == 1.0
    short = wf.storage.capture(setting, method=method, pool=20, grow=False)
    assert 0 < short.captured < found.captured
    assert set(pairs_of(setting, short.fragments)) < set(pairs_of(setting, found.fragments))


@pytest.mark.parametrize("method", METHODS)
def test_threads_make_no_difference(method, monkeypatch):
    """The same bits for any number of threads, on an image of many pieces."""
    setting = planted(13, size=(50, 40), most=6)
    expected = None
    for threads in (1, 2, 3):
        monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
        found = wf.storage.capture(setting, method=method, **options_of(method, slots=3)).fragments
        expected = expected or found
        assert_same(found, expected)


@pytest.mark.parametrize("method", METHODS)
def test_double_precision(method):
    """float64 values in, float64 fragments out, the sets that the reference finds among these."""
    setting = planted(14)
    double = {"soup.opacity": np.full(30, 0.4)}
    options = options_of(method, slots=3, buckets=2)
    found = wf.storage.capture(setting, method=method, parameters=double, **options)
    assert found.fragments.depth.dtype == np.float64
    pixels = true_pixels(setting, parameters=double)
    assert pairs_of(setting, found.fragments) == expected_pairs(
        method, pixels, **{**dict(METHODS[method].defaults), **options}
    )


@pytest.mark.parametrize("method", METHODS)
def test_images_without_fragments(method):
    """Nothing is captured, nothing is lost."""
    setting = scene(perspective((5, 4)), quad(2.0))
    behind = {"quad.translation": [0.0, 0.0, -5.0]}
    with pytest.warns(EmptyImageWarning, match="no object of the scene"):
        found = wf.storage.capture(setting, method=method, parameters=behind)
    assert found.captured == found.seen == found.lost == 0
    assert found.robustness == 1.0
    assert found.fragments.shape == (4, 5)
    assert found.passes >= 1
    single = wf.storage.capture(scene(orthographic((1, 1)), quad(2.0)), method=method)
    assert single.captured == single.seen == 1
