"""Every method of the papers against plain loops over the true list of fragments of each pixel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference_storage as reference
import torch
from capture_scenes import orthographic, perspective, pixels_of, quad, scene, soup, surface

import warpfrag as wf
from warpfrag.capture.coverage import Coverage, capture
from warpfrag.scene.surface import SceneObject
from warpfrag.storage.methods import METHODS

OUTPUTS = ("rgba", "depth", "thickness", "offsets", "object_id", "primitive_id")
DEPTH_BITS = [name for name, method in METHODS.items() if "depth_bits" in method.options]
APPROXIMATE = [name for name in METHODS if name not in reference.ROBUST]


def planted(seed: int = 0, size=(13, 11), most: int = 40):
    """Return random triangles, of which some come again and again at the same place, 1 to `most` times."""
    random = np.random.default_rng(seed)
    objects: list[SceneObject] = [soup(seed, 10)]
    for number, copies in enumerate((1, 2, 3, 5, 9, most)):
        vertices = random.uniform([-1.2, -1.2, 1.5], [1.2, 1.2, 3.0], (3, 3))
        objects.append(surface(vertices, np.tile([[0, 1, 2]], (copies, 1)), f"planted{number}", opacity=0.3))
    return scene(perspective(size), *objects, soup(seed + 1, 10, name="more"))


def items_of(setting, fragments) -> np.ndarray:
    """Return the number of each fragment's triangle in the whole scene."""
    first = np.cumsum([0, *(len(item.faces) for item in setting.objects)])
    return first[fragments.object_id] + fragments.primitive_id


def pairs_of(setting, fragments) -> list[tuple[int, int]]:
    """Return pixel and triangle of each fragment, in order."""
    return sorted(zip(pixels_of(fragments).tolist(), items_of(setting, fragments).tolist(), strict=True))


def true_pixels(setting, keys_of=None, **options) -> list[list[tuple]]:
    """Return the pairs (triangle, key) of each pixel, in order of submission."""
    fragments = capture(setting, sort=False, **options).numpy()
    keys = fragments.depth if keys_of is None else keys_of(fragments)
    items = items_of(setting, fragments)
    return [
        list(zip(items[begin:end].tolist(), keys[begin:end].tolist(), strict=True))
        for begin, end in zip(fragments.offsets, fragments.offsets[1:], strict=False)
    ]


def expected_pairs(method: str, pixels, **options) -> list[tuple[int, int]]:
    """Return pixel and triangle of what the reference captures, in order."""
    parts = (reference.captured(method, pixel, **options) for pixel in pixels)
    return sorted((number, item) for number, part in enumerate(parts) for item, _ in part)


def assert_same(found, expected) -> None:
    """Compare fragments to the bit."""
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def options_of(method: str, **options):
    """Return those options that a method takes, and its own defaults."""
    return {name: value for name, value in options.items() if name in METHODS[method].options}


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


@pytest.mark.parametrize("words", [1, 4])
@pytest.mark.parametrize("method", ["kb", "k_plus_array", "k_plus_heap"])
def test_occupancy_culling_changes_nothing(method, words):
    """The K nearest are those without a map; two more passes."""
    setting = planted(12)
    plain = wf.storage.capture(setting, method=method, slots=4)
    culled = wf.storage.capture(setting, method=method, slots=4, cull="occupancy", words=words)
    assert_same(culled.fragments, plain.fragments)
    assert culled.passes == plain.passes + 2
    assert culled.paper_bytes - plain.paper_bytes == (words + 3) * 4 * 13 * 11


def test_occupancy_culling_leaves_fewer_hazards():
    """Fragments that are culled do not disturb: more of the K nearest survive (as Vasilakis and Papaioannou say)."""
    setting = planted(12, most=30)
    nearest = set(pairs_of(setting, wf.storage.capture(setting, method="kb", slots=4).fragments))
    plain, culled = (
        len(nearest & set(pairs_of(setting, wf.storage.capture(
            setting, method="kb", slots=4, hazard=3, **options).fragments)))
        for options in ({}, {"cull": "occupancy", "words": 16})
    )  # fmt: skip
    assert culled >= plain


@pytest.mark.parametrize("method", [name for name, each in METHODS.items() if "cull_objects" in each.options])
def test_objects_that_are_peeled_are_left_out(method):
    """Later passes are given fewer objects; fragments and passes are the same."""
    near = [soup(seed, 6, name=f"near{seed}", z=(1.0, 1.4)) for seed in range(2)]
    behind = [soup(5, 12, z=(2.0, 3.0)), quad(4.0), quad(4.0, name="twin"), quad(5.0, name="wall")]
    setting = scene(perspective((20, 18)), *near, *behind)
    plain = wf.storage.capture(setting, method=method)
    culled = wf.storage.capture(setting, method=method, cull_objects=True)
    assert_same(culled.fragments, plain.fragments)
    assert culled.passes == plain.passes
    assert set(plain.objects) == {6}
    assert culled.objects[0] == 6
    assert list(culled.objects) == sorted(culled.objects, reverse=True)
    assert culled.objects[-1] < 6


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
    found = wf.storage.capture(setting, method=method, parameters=behind)
    assert found.captured == found.seen == found.lost == 0
    assert found.robustness == 1.0
    assert found.fragments.shape == (4, 5)
    assert found.passes >= 1
    single = wf.storage.capture(scene(orthographic((1, 1)), quad(2.0)), method=method)
    assert single.captured == single.seen == 1


@pytest.mark.parametrize("method", METHODS)
def test_memory_is_reported_and_refused(method):
    """By buffer, beside the formula of the paper; more than allowed is an error with both numbers."""
    setting = planted(15)
    found = wf.storage.capture(setting, method=method)
    assert all(size > 0 for size in found.bytes.values())
    assert found.bytes["lists.offsets" if "lists.offsets" in found.bytes else "offsets"] == 4 * (13 * 11 + 1)
    assert found.formula
    assert found.paper_bytes > 0
    with pytest.raises(MemoryError, match=r"would take .* expected at most 9\.766 KiB"):
        wf.storage.capture(setting, method=method, memory_limit=10_000)


def test_memory_of_some_methods_by_hand():
    """Two squares over 8 × 8 pixels: 128 fragments, 64 a layer."""
    setting = scene(perspective((8, 8)), quad(2.0), quad(3.0, name="other"))
    expected = {"dfb": 2 * 2, "s_buffer": 2 * 2 + 3, "fixed_array": 2 * 8 + 2, "linked_list": 3 * 2 + 3,
                "paged_list": 2 * 4, "f2b_ll": 2 + 4, "f2b_fab": 8 + 4, "dual_2p": 20, "bun_ll": 3 * 2 + 8}  # fmt: skip
    for method, words in expected.items():
        assert wf.storage.capture(setting, method=method).paper_bytes == words * 4 * 64
    own = wf.storage.capture(setting, method="fixed_array", slots=4).bytes
    assert own["kept.items"] == own["kept.depths"] == 64 * 4 * 4
    assert own["lists.items"] == own["lists.depths"] == 128 * 4
    nodes = wf.storage.capture(setting, method="linked_list", pool=200).bytes
    assert nodes["nodes.items"] == 800


def test_slots_are_refused_before_they_are_allocated():
    """An array of slots that no memory holds."""
    setting = scene(perspective((8, 8)), quad(2.0))
    for method in ("fixed_array", "kb", "srab", "k_plus_array", "f2b_fab"):
        with pytest.raises(MemoryError, match=r"slots for each of 64 pixels|peeling 64 pixels"):
            wf.storage.capture(setting, method=method, slots=2**28, memory_limit=1e9)
    with pytest.raises(MemoryError, match=r"a pool of 4\d+ fragments would take"):
        wf.storage.capture(setting, method="linked_list", pool=4 * 10**9, memory_limit=1e9)


@pytest.mark.parametrize("method", ["f2b_2p", "dual_ll", "linked_list", "s_buffer", "kb"])
def test_gradients_are_those_of_every_capture(method):
    """Shading does not know how fragments were found."""
    setting = scene(perspective((9, 8)), soup(1, 6), soup(1, 6, name="again"))
    options = options_of(method, slots=99)

    def gradient(find):
        opacity = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
        fragments = find({"soup.opacity": opacity, "again.translation": torch.zeros(3, dtype=torch.float64)})
        return torch.autograd.grad((fragments.rgba * torch.arange(4)).sum() + fragments.depth.sum(), opacity)[0]

    found = gradient(lambda values: wf.storage.capture(setting, method=method, parameters=values, **options).fragments)
    assert found == gradient(lambda values: capture(setting, parameters=values)) != 0.0


def test_any_method_in_place_of_the_dynamic_fragment_buffer():
    """`wf.capture` and `Coverage.of` take a method; what one loses is said."""
    setting = planted(16)
    assert_same(wf.capture(setting, method="dual_2p"), capture(setting))
    assert_same(Coverage.of(setting, method="paged_list").shade(), capture(setting))
    every, lossy = capture(setting).count, wf.storage.capture(setting, method="f2b").captured
    with pytest.warns(UserWarning, match=rf"method: f2b captured {lossy} of {every} fragments; it loses all but one"):
        found = wf.capture(setting, method="f2b")
    assert found.count == lossy
    part = wf.capture(setting, method="f2b_ll", rows=(3, 8))
    assert_same(part, wf.capture(setting, rows=(3, 8)))


def test_options_are_checked():
    """Each bad one is named, with what was got and what is expected."""
    setting = scene(perspective((4, 4)), quad(2.0))

    def refuse(error, message, method, **options):
        with pytest.raises(error, match=message):
            wf.storage.capture(setting, method=method, **options)

    refuse(ValueError, r'method: got "f2b_p2", expected one of .* \(did you mean "f2b_3p"\?\)', "f2b_p2")
    refuse(TypeError, r"slots: got 4, expected no such option of dfb \(it takes no options\)", "dfb", slots=4)
    refuse(TypeError, r'slot: got 4, expected no such option of kb \(did you mean "slots"\?\)', "kb", slot=4)
    for option, method in (("slots", "kb"), ("page", "paged_list"), ("buckets", "bun"), ("words", "bad"),
                           ("hazard", "kb"), ("pool", "linked_list"), ("max_passes", "f2b")):  # fmt: skip
        refuse(ValueError, f"{option}: got 0, expected a whole number of at least 1", method, **{option: 0})
        refuse(TypeError, f"{option}: got 1.5, expected a whole number of at least 1", method, **{option: 1.5})
    refuse(ValueError, "depth_bits: got 25, expected a whole number from 1 to 24", "f2b", depth_bits=25)
    refuse(TypeError, "grow: got 1, expected True or False", "linked_list", grow=1)
    refuse(TypeError, 'packed: got "yes", expected True or False', "f2b_fab", packed="yes")
    refuse(TypeError, "cull_objects: got None, expected True or False", "f2b", cull_objects=None)
    refuse(ValueError, 'cull: got "map", expected "occupancy"', "kb", cull="map")
    refuse(ValueError, "words: got 1, expected a whole number of at least 2", "kb", slots=32, cull="occupancy", words=1)
    refuse(ValueError, "depth_bits: got 16 with cull_objects, expected None", "f2b", depth_bits=16, cull_objects=True)
    refuse(ValueError, "depth_bits: got 16 with cull, expected None", "kb", depth_bits=16, cull="occupancy")
    with pytest.raises(TypeError, match="scene: got int, expected a Scene"):
        wf.storage.capture(3)
    with pytest.raises(ValueError, match='method: got "all", expected one of'):
        wf.capture(setting, method="all")
