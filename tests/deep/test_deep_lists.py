"""Fragments put together, sorted and divided: values by hand, gradients, kinds of arrays, refusals."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from fragment_arrays import fragments_of
from pixels import random_pixels

import warpfrag as wf
from warpfrag.deep import concat, split, tidy

GREEN, RED, BLUE = (0, 0.5, 0, 0.5, 2.0, 0.5), (0.25, 0, 0, 0.25, 1.0, 0.0), (0, 0, 1, 1, 3.0, 1.0)


def lists(*pixels, **ids):
    """Build fragments of a row of pixels, with ids."""
    fragments = wf.Fragments.from_lists(list(pixels), (1, len(pixels)))
    return replace(fragments, **{name: np.array(values, np.int32) for name, values in ids.items()})


def test_each_pixel_has_those_of_the_first_then_the_second():
    """The lists of a pixel follow one another, empty ones included."""
    both = concat(lists([GREEN], [], [BLUE]), lists([RED], [RED, BLUE], []))
    expected = lists([GREEN, RED], [RED, BLUE], [BLUE])
    for name in ("rgba", "depth", "thickness", "offsets"):
        np.testing.assert_array_equal(getattr(both, name), getattr(expected, name))
    assert both.object_id is None


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
def test_any_number_and_kind(count, kind, device):
    """All kinds of arrays, and any number of images, give the lists that NumPy would put together."""
    pixels = [random_pixels(seed, pixel_count=30) for seed in range(count)]
    if kind == "numpy" and device != "cpu":
        pytest.skip("NumPy arrays are on the host")
    found = concat(*(fragments_of(each, "float32", kind=kind, device=device) for each in pixels))
    assert found.kind == kind
    found = found.numpy()
    found.validate()
    own = np.concatenate([np.repeat(np.arange(30), np.diff(each.offsets)) for each in pixels])
    order = np.argsort(own, kind="stable")
    np.testing.assert_array_equal(found.rgba, np.concatenate([each.rgba for each in pixels])[order].astype("float32"))
    np.testing.assert_array_equal(found.depth, np.concatenate([each.depth for each in pixels])[order])
    np.testing.assert_array_equal(found.pixel, own[order])


def test_ids_are_kept_or_counted_on():
    """Ids stay what they are, or each image's begin after those before; where one has none there are none."""
    first, second = lists([RED], [GREEN], object_id=[0, 3], primitive_id=[7, 8]), lists([BLUE], [], object_id=[1])
    assert concat(first, second).object_id.tolist() == [0, 1, 3]
    assert concat(first, second, renumber=True).object_id.tolist() == [0, 5, 3]
    assert concat(first, second, renumber=True).primitive_id is None
    assert concat(first, lists([RED], [])).object_id is None


def test_missing_opacity_sums_are_opacities():
    """Where one image has opacity sums, those of the other are what their lack stands for."""
    first = replace(lists([GREEN]), opacity_sum=np.array([2.0], np.float32))
    assert concat(lists([RED]), first, lists([BLUE])).opacity_sum.tolist() == [0.25, 2.0, 1.0]


def test_gradients_go_back_to_all():
    """The gradients of every input agree with finite differences, also of an opacity that is an opacity sum."""
    torch = pytest.importorskip("torch")
    parts = [fragments_of(random_pixels(seed, 5, 3), kind="torch") for seed in (1, 2)]
    sums = torch.rand(parts[1].count, dtype=torch.float64)
    names = ("rgba", "depth", "thickness")

    def values(*arrays):
        first = replace(parts[0], **dict(zip(names, arrays[:3], strict=True)))
        second = replace(parts[1], **dict(zip((*names, "opacity_sum"), arrays[3:], strict=True)))
        both = tidy(concat(first, second))
        return both.rgba, both.depth, both.thickness, both.opacity_sum

    arrays = [getattr(part, name) for part in parts for name in names] + [sums]
    assert torch.autograd.gradcheck(values, [array.clone().requires_grad_() for array in arrays])


def test_a_tape_twice_gives_twice_the_gradient(device):
    """Recorded on a tape, gradients add up, and those of the image are those of torch's path."""
    first, second = (
        fragments_of(random_pixels(seed, 6), "float32", kind="warp", device=device, requires_grad=True)
        for seed in (3, 4)
    )
    with wp.Tape() as tape:
        image = wf.composite(concat(first, second), merge="none")
    image.grad.fill_(1.0)
    tape.backward()
    once = [each.rgba.grad.numpy().copy() for each in (first, second)]
    image.grad.fill_(1.0)
    tape.backward()
    for each, grad in zip((first, second), once, strict=True):
        np.testing.assert_array_equal(each.rgba.grad.numpy(), 2.0 * grad)
    assert all(np.abs(grad).max() > 0.1 for grad in once)


def test_tidy_sorts_and_drops_what_is_empty():
    """Depth decides, then the front; what neither hides nor shines goes, what only shines stays."""
    nothing, shine = (0, 0, 0, 0, 1.5, 0.0), (0.5, 0, 0, 0, 1.5, 0.0)
    found = tidy(lists([BLUE, nothing, GREEN, RED, shine], [nothing], [(0, 0, 1, 1, 3.0, 2.0), BLUE]))
    assert found.offsets.tolist() == [0, 4, 4, 6]
    assert found.depth.tolist() == [1.0, 1.5, 2.0, 3.0, 3.0, 3.0]
    assert found.thickness[4:].tolist() == [2.0, 1.0]


def test_split_divides_by_object():
    """Each object's fragments are on the whole grid; together they are all again."""
    whole = lists([GREEN, RED], [BLUE], [], object_id=[4, 2, 4])
    parts = split(whole)
    assert list(parts) == [2, 4]
    assert parts[4].offsets.tolist() == [0, 1, 2, 2]
    np.testing.assert_array_equal(tidy(concat(*parts.values())).rgba, tidy(whole).rgba)
    with pytest.raises(ValueError, match="object_id"):
        split(lists([RED]))


@pytest.mark.parametrize(
    ("others", "error", "message"),
    [
        ([lists([RED], [])], ValueError, "fragments 2: got a grid of 1×2 pixels, expected 1×1 like the first"),
        ([lists([RED]), 3], TypeError, "fragments 3: got 3, expected Fragments"),
        ([lists([RED]).to("float64")], TypeError, "fragments 2: got float64, expected float32 like the first"),
        ([replace(lists([RED]), offsets=np.array([0, 2]))], ValueError, "offsets: got"),
    ],
)
def test_what_does_not_fit_is_refused(others, error, message):
    """One line names which does not fit, and to what."""
    with pytest.raises(error, match=message):
        concat(lists([GREEN]), *others)
    with pytest.raises(TypeError, match="got none"):
        concat()
