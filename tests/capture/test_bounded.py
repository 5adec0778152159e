"""The bounded capture: the layers of stored fragments to the bit, their gradients, culling, memory."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from capture_scenes import orthographic, perspective, quad, scene, soup

from warpfrag.capture import bounded as module
from warpfrag.capture.bounded import capture_kbuffer, count_culled, kbuffer_bytes
from warpfrag.capture.coverage import capture
from warpfrag.storage.kbuffer import kbuffer

OUTPUTS = ("rgba", "depth", "thickness", "opacity_sum", "count")
EVERY_WAY = [(merge, tail) for merge in ("order_independent", "none") for tail in ("mix", "discard")]


def crowd(size=(50, 41), count=120):
    """Return a scene of many layers: textured, coplanar, with a thickness map and one in multiples of P."""
    random = np.random.default_rng(0)
    uv = [[0, 0], [3, 0], [3, 2], [0, 2]]
    return scene(
        perspective(size),
        soup(1, count),
        quad(2.0, opacity=0.5, uv=np.array(uv, np.float32), texture=random.random((5, 7, 4), np.float32)),
        quad(2.0, name="twin", opacity=0.3, thickness=random.uniform(0.0, 0.3, size[::-1]).astype(np.float32)),
        soup(2, count, name="more", thickness=3e4, thickness_unit="P"),
    )


def assert_same(found, expected) -> None:
    """Compare layers to the bit."""
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.mark.parametrize(("merge", "tail"), EVERY_WAY)
def test_layers_are_those_of_stored_fragments(merge, tail):
    """To the bit, for any number of slots."""
    setting = crowd()
    fragments = capture(setting, sort=False)
    assert np.diff(fragments.offsets).max() > 50
    for slots in (1, 2, 8, 70):
        expected = kbuffer(fragments, slots, merge=merge, tail=tail)
        assert_same(capture_kbuffer(setting, slots=slots, merge=merge, tail=tail), expected)


def test_double_precision_and_orthographic_camera():
    """Any float64 parameter makes everything float64; a tensor makes it torch."""
    setting = scene(orthographic((33, 20), 2.0), soup(3, 60))
    double = {"soup.opacity": np.float64(0.4) * np.ones(180)}
    expected = kbuffer(capture(setting, sort=False, parameters=double), 4)
    found = capture_kbuffer(setting, slots=4, parameters=double)
    assert found.rgba.dtype == np.float64
    assert_same(found, expected)
    found = capture_kbuffer(setting, slots=4, parameters={"soup.opacity": torch.tensor(0.4)})
    assert isinstance(found.rgba, torch.Tensor)
    assert_same(found.numpy(), kbuffer(capture(setting, sort=False, parameters={"soup.opacity": 0.4}), 4))


@pytest.mark.parametrize("cull", [None, "occupancy"])
def test_threads_make_no_difference(monkeypatch, cull):
    """The same bits for any number of threads, on an image of many pieces."""
    setting = crowd((100, 90))
    options = {"merge": "none", "tail": "discard", "cull": cull} if cull else {}
    expected = None
    for threads in (1, 2, 3, 8):
        monkeypatch.setenv("WARPFRAG_THREADS", str(threads))
        found = capture_kbuffer(setting, slots=4, **options)
        expected = expected or found
        assert_same(found, expected)


def gradients(layers_of, setting, seed: int = 0) -> dict[str, torch.Tensor]:
    """Return the gradients in some parameters of all outputs of `layers_of(setting, parameters)`."""
    own = setting.parameters()
    names = ("soup.vertices", "soup.color", "quad.opacity", "twin.thickness", "more.thickness")
    tensors = {name: torch.tensor(own[name], dtype=torch.float64, requires_grad=True) for name in names}
    layers = layers_of(setting, tensors)
    random = torch.Generator().manual_seed(seed)
    outputs = [getattr(layers, name) for name in OUTPUTS[:4]]
    seeds = [torch.randn(o.shape, dtype=o.dtype, generator=random) for o in outputs]
    return dict(zip(names, torch.autograd.grad(outputs, list(tensors.values()), seeds), strict=True))


@pytest.mark.parametrize(("merge", "tail"), EVERY_WAY)
def test_gradients_are_those_of_stored_fragments(merge, tail, monkeypatch):
    """In vertices, colour, opacity, map and multiples of P; by bands of rows as at once."""
    setting = crowd((30, 24), 40)
    options = {"slots": 3, "merge": merge, "tail": tail}

    def stored(setting, parameters):
        return kbuffer(capture(setting, sort=False, parameters=parameters), **options)

    def bounded(setting, parameters):
        return capture_kbuffer(setting, parameters=parameters, **options)

    expected = gradients(stored, setting)
    for band_bytes in (module.BAND_BYTES, 1 << 16):
        monkeypatch.setattr(module, "BAND_BYTES", band_bytes)
        found = gradients(bounded, setting)
        for name, values in expected.items():
            scale = float(values.abs().max())
            assert scale > 0.0 or (name.endswith("thickness") and merge == "none")
            torch.testing.assert_close(found[name], values, rtol=1e-9, atol=1e-12 * scale)


@pytest.mark.parametrize("words", [1, 2, 16])
@pytest.mark.parametrize("slots", [1, 4, 31])
def test_culling_changes_nothing(slots, words):
    """Occupancy culling leaves the K nearest to the bit, and the k+-buffer's test finds what is left."""
    setting = crowd()
    options = {"slots": slots, "merge": "none", "tail": "discard"}
    expected = capture_kbuffer(setting, **options)
    assert_same(capture_kbuffer(setting, cull="occupancy", words=words, **options), expected)
    plain, mapped = (
        count_culled(setting, slots=slots),
        count_culled(setting, slots=slots, cull="occupancy", words=words),
    )
    np.testing.assert_array_equal(plain.fragments, mapped.fragments)
    assert not plain.occupancy.any()
    assert mapped.occupancy.sum() > 0
    # Whatever is culled, the K nearest are shaded.
    assert (mapped.shaded >= np.minimum(mapped.fragments, slots)).all()
    assert (mapped.shaded <= plain.shaded).all()


def test_lemma_that_the_foremost_always_pass():
    """Lemma 2.1: what is culled is what buckets computed here cull, and never among the K nearest."""
    setting, slots, words = crowd(), 5, 2
    fragments = capture(setting, sort=False)
    counts = count_culled(setting, slots=slots, cull="occupancy", words=words)
    culled_fragments = 0
    for pixel, (begin, end) in enumerate(zip(fragments.offsets, fragments.offsets[1:], strict=False)):
        depth = np.sort(fragments.depth[begin:end].astype(np.float64))
        if len(depth):
            extent = depth[-1] - depth[0]
            buckets = np.minimum((depth - depth[0]) / (extent or 1.0) * (32 * words), 32 * words - 1).astype(int)
            occupied = np.unique(buckets)
            last = occupied[slots - 1] if len(occupied) >= slots else 32 * words
            culled = buckets > last
            assert not culled[:slots].any()
            assert counts.occupancy.reshape(-1)[pixel] == culled.sum()
            culled_fragments += culled.sum()
    assert culled_fragments > 1000


def test_memory_does_not_grow_with_layers(monkeypatch):
    """What is allocated is the formula's H·W·(K·28 + 4) bytes, and the lists of triangles; at 8 layers as at 200."""

    def allocated(layers: int) -> list[int]:
        """Capture 200 squares, of which some cover the image, and return the sizes of all arrays of pixels."""
        stack = [
            quad(1.0 + 0.01 * i, half=10.0 if i < layers else 1e-3, name=f"quad{i}", opacity=0.1) for i in range(200)
        ]
        setting = scene(perspective((64, 48)), *stack)
        sizes = []
        original = wp.empty

        def recording(*args, **kwargs):
            array = original(*args, **kwargs)
            sizes.append(array.capacity)
            return array

        with monkeypatch.context() as patch:
            patch.setattr(wp, "empty", recording)
            found = capture_kbuffer(setting, slots=6)
        assert sum(getattr(found, name).nbytes for name in OUTPUTS) == kbuffer_bytes(64 * 48, 6)
        return sorted(sizes)

    few, many = allocated(8), allocated(200)
    assert few == many
    # Beside the layers: corners and boxes of 400 triangles.
    assert sum(many) == 64 * 48 * (6 * 28 + 4) + 400 * (12 + 16)
    assert kbuffer_bytes(64 * 48, 6) == 64 * 48 * (6 * 28 + 4)
    assert kbuffer_bytes(10, 8, wp.float64, map_words=4) == 10 * (8 * 56 + 4 + 16 + 16 + 4)


def test_nothing_in_view():
    """A scene without anything to see has no layers, and gradients of zero."""
    opacity = torch.tensor(0.5, requires_grad=True)
    layers = capture_kbuffer(scene(perspective((20, 10)), quad(-2.0)), parameters={"quad.opacity": opacity})
    assert layers.rgba.shape == (10, 20, 8, 4)
    assert not layers.count.any()
    layers.rgba.sum().backward()
    assert opacity.grad == 0.0


def test_arguments_are_checked():
    """Wrong arguments are named, and what does not go together."""
    setting = scene(perspective((20, 10)), quad(2.0))
    with pytest.raises(TypeError, match="scene: got str"):
        capture_kbuffer("scene.toml")
    with pytest.raises(ValueError, match="slots: got -1"):
        capture_kbuffer(setting, slots=-1)
    with pytest.raises(ValueError, match='cull: got "occupancy" with merge="order_independent" and tail="mix"'):
        capture_kbuffer(setting, cull="occupancy")
    plain = {"merge": "none", "tail": "discard"}
    with pytest.raises(ValueError, match='cull: got "early"'):
        capture_kbuffer(setting, cull="early", **plain)
    with pytest.raises(ValueError, match="words: got 1, expected a whole number of at least 2"):
        capture_kbuffer(setting, slots=32, cull="occupancy", words=1, **plain)
    with pytest.raises(
        MemoryError, match=r"8 slots for each of 200 pixels would take 44\.53 KiB, expected at most 1000 B"
    ):
        capture_kbuffer(setting, memory_limit=1000)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux tells the peak of a process's memory")
def test_millions_of_triangles_within_a_gibibyte():
    """2.8 million triangles at 1024² with more than 130 layers take less than 1 GiB beyond the mesh."""
    script = """
from pathlib import Path
import numpy as np
from capture_scenes import orthographic, quad, scene, surface
from warpfrag.capture.bounded import capture_kbuffer, count_culled

random, count = np.random.default_rng(0), 2_800_000
place = random.uniform([-512, -512, 2], [512, 512, 50], (count, 1, 3)).astype(np.float32)
corners = place + random.uniform(-13, 13, (count, 3, 3)).astype(np.float32) * np.float32([1, 1, 0.02])
setting = scene(orthographic((1024, 1024)), surface(corners.reshape(-1, 3), np.arange(3 * count), opacity=0.1))
del place, corners
capture_kbuffer(scene(orthographic((64, 64)), quad(2.0)))

def kibibytes(key):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(key)))

before = kibibytes("VmRSS")
# Forgets the peak so far.
Path("/proc/self/clear_refs").write_text("5")
layers = capture_kbuffer(setting)
peak = kibibytes("VmHWM")
print("found", peak - before, layers.count.max(), count_culled(setting).fragments.max())
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd="tests", check=True)
    kibibytes, most, layers = map(int, result.stdout.rpartition("found")[2].split()[:3])
    assert kibibytes < 1 << 20
    assert most == 8
    assert layers > 130
