"""How much memory a capture, an image and their gradients may take."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from capture_scenes import perspective, quad, scene

from warpfrag.capture import memory
from warpfrag.capture.coverage import capture
from warpfrag.capture.surfaces import surfaces_of
from warpfrag.raster.ray import Window
from warpfrag.render import render


def test_split_rows_takes_as_few_bands_as_fit():
    """Rows are packed from the top; a row that does not fit is an error with both numbers."""
    counts = np.array([1, 1, 2, 0, 3, 1])
    assert memory.split_rows(counts, 10.0 * counts, 40.0) == [(0, 4), (4, 6)]
    assert memory.split_rows(counts, 10.0 * counts, 80.0) == [(0, 6)]
    assert memory.split_rows(counts, 10.0 * counts, 30.0) == [(0, 2), (2, 4), (4, 5), (5, 6)]
    with pytest.raises(MemoryError, match=r"row 4 with its 3 fragments would take 30 B, expected at most 29 B"):
        memory.split_rows(counts, 10.0 * counts, 29.0)


def test_memory_is_refused_with_both_numbers():
    """A capture, or a row of an image, beyond the limit is refused before anything is stored."""
    setting = scene(perspective((64, 64)), quad(2.0), quad(3.0, name="other"))
    with pytest.raises(MemoryError, match=r"8192 fragments would take 32\d KiB, expected at most 97\.66 KiB"):
        capture(setting, memory_limit=100_000)
    assert capture(setting, memory_limit=340_000).count == 8192
    # 131072 bytes for the image and its copy, and 5120 for a row.
    with pytest.raises(MemoryError, match=r"row 0 with its 128 fragments would take 134 KiB, expected at most 127 KiB"):
        render(setting, memory_limit=130_000)
    assert render(setting, memory_limit=140_000).shape == (64, 64, 4)


def test_gradients_are_counted_in_the_prediction():
    """With gradients a fragment takes more memory, and so do vertices, strips and the image."""
    setting = scene(perspective((64, 64)), quad(2.0), quad(3.0, name="other"))
    values = {"quad.opacity": torch.tensor(0.5, requires_grad=True)}
    with pytest.raises(MemoryError, match=r"8192 fragments would take 51\d"):
        capture(setting, parameters=values, memory_limit=340_000)
    assert capture(setting, parameters=values, memory_limit=600_000).count == 8192
    surfaces = surfaces_of(setting, setting.camera, values)
    sizes = memory.CaptureSizes.of(surfaces.triangles(Window.of(setting.camera)), surfaces)
    # Each of the 4 triangles covers 64 rows of 64 columns: 4 strips of 16 rows.
    assert sizes.strip_count == 16
    assert sizes.gradient_bytes > 16 * memory.STRIP_BYTES


def test_default_limit_is_half_of_the_free_memory(monkeypatch):
    """Without a limit, half of what the system says is free; all where it says nothing."""
    cpu = wp.get_device("cpu")
    assert memory.free_memory(cpu) > 2**20
    monkeypatch.setattr(memory, "free_memory", lambda device: 1000)
    assert memory.allowed_memory(None, cpu) == 500
    with pytest.raises(MemoryError, match="expected at most 500 B"):
        capture(scene(perspective((64, 64)), quad(2.0)))
    monkeypatch.setattr(memory, "free_memory", lambda device: None)
    assert memory.allowed_memory(None, cpu) == float("inf")


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux tells the peak of a process's memory")
@pytest.mark.slow
def test_images_and_their_gradients_keep_to_the_limit():
    """A process grows by no more than the limit, whether an image is differentiated or not; without it, by more."""
    script = """
import sys
from pathlib import Path
import numpy as np
import torch
from capture_scenes import perspective, quad, scene
from warpfrag.render import render

def setting(size):
    objects = [quad(2.0 + 0.1 * i, name=f"quad{i}", opacity=0.1) for i in range(8)]
    return scene(perspective(size), *objects, background=(0.1, 0.2, 0.3, 1.0))

def kibibytes(key):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(key)))

def run(size, limit, differentiate):
    opacity = torch.tensor(0.5, requires_grad=differentiate)
    image = render(setting(size), parameters={"quad1.opacity": opacity}, memory_limit=limit)
    if differentiate:
        image.sum().backward()
    return image

for differentiate in (False, True):
    for limit in (None, 40 * 2**20):
        run((32, 32), 5e5, differentiate)
        before = kibibytes("VmRSS")
        # Forgets the peak so far.
        Path("/proc/self/clear_refs").write_text("5")
        run((500, 500), limit, differentiate)
        print("grown", (kibibytes("VmHWM") - before) / 1024)
"""
    # Else malloc keeps what was freed.
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"}
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd="tests", check=True, env=environment
    )
    free, kept, free_gradient, kept_gradient = (float(part.split()[0]) for part in result.stdout.split("grown")[1:])
    assert free > 60
    assert free_gradient > 90
    assert kept < 40
    assert kept_gradient < 40
