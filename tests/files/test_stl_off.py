"""STL and OFF files: colours of triangles and vertices, text and binary."""

import struct

import numpy as np
import pytest

from warpfrag.files.meshes import load_mesh

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
HALF = 0.21586050011389926  # 128/255 in sRGB, in linear light


def stl(folder, attributes, header=b""):
    """Write a binary STL of a triangle for each attribute."""
    data = header.ljust(80, b"\0") + struct.pack("<I", len(attributes))
    for shift, attribute in enumerate(attributes):
        data += struct.pack("<3f", 0, 0, 1) + (TRIANGLE + shift).astype("f4").tobytes() + struct.pack("<H", attribute)
    path = folder / "a.stl"
    path.write_bytes(data)
    return path


def test_viscam_colours(tmp_path):
    """The flag says that a triangle has a colour, red in the upper bits; without flags there are none."""
    mesh = load_mesh(stl(tmp_path, [0x8000 | 31 << 10, 0x8000 | 31, 0]))
    np.testing.assert_allclose(mesh.color[mesh.faces[:, 0]], [[1, 0, 0], [0, 0, 1], [0.8] * 3])
    assert load_mesh(stl(tmp_path, [0, 31])).color is None


def test_magics_colours(tmp_path):
    """A header with COLOR= turns the flag and the order round, and has the colour and opacity of the rest."""
    header = b"COLOR=" + bytes([128, 0, 255, 51])
    mesh = load_mesh(stl(tmp_path, [31, 0x8000], header))
    np.testing.assert_allclose(mesh.color[mesh.faces[:, 0]], [[1, 0, 0], [HALF, 0, 1]])
    np.testing.assert_allclose(mesh.opacity[mesh.faces[:, 0]], [1.0, 0.2])
    mesh = load_mesh(stl(tmp_path, [0, 0], header))
    np.testing.assert_allclose(mesh.color, [HALF, 0, 1])


def test_binary_files_that_begin_like_text(tmp_path):
    """A header "solid" of a binary file does not make it text; a file that is too short is refused."""
    assert len(load_mesh(stl(tmp_path, [0, 0], b"solid x")).faces) == 2
    path = stl(tmp_path, [0, 0])
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="got 183 bytes for 2 triangles, expected 184"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("text", "color"),
    [
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 128 0 255\n", [HALF, 0, 1]),
        ("COFF\n3 1 0\n" + "0 0 0 128 0 255 255\n1 0 0 128 0 255 255\n0 1 0 128 0 255 255\n3 0 1 2\n", [HALF, 0, 1]),
        ("OFF 3 1 0 # counts\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 1.0 0.0 0.5\n", [1, 0, 0.2140411]),
    ],
)
def test_off_colours(tmp_path, text, color):
    """Colours of faces and of vertices, whole numbers of 255 or shares."""
    (tmp_path / "a.off").write_text(text)
    np.testing.assert_allclose(load_mesh(tmp_path / "a.off").color, [color] * 3, rtol=1e-6)
