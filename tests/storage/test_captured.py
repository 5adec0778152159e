"""What a capture by any method tells about itself: memory, what was culled; gradients, and options that are refused."""

import pytest
import torch
from capture_scenes import perspective, quad, scene, soup
from planted_scenes import assert_same, options_of, pairs_of, planted

import warpfrag as wf
from warpfrag.capture.coverage import Coverage, capture
from warpfrag.storage.methods import METHODS


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
