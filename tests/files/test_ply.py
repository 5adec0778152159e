"""PLY meshes: polygons, strips, colours and images of every kind, in text and binary of both byte orders."""

import struct

import numpy as np
import pytest
from PIL import Image

from warpfrag.files.meshes import load_mesh
from warpfrag.files.ply import read_ply
from warpfrag.files.points import load_points

POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
XYZ = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"
HALF = 0.21586050011389926  # 128/255 in sRGB, in linear light


def write(folder, body, vertex="", face="", *, points=POINTS, faces=None, form="ascii", comments=""):
    """Write a PLY file of these points; `body` are its entries."""
    faces = 2 if faces is None else faces
    head = f"ply\nformat {form} 1.0\n{comments}element vertex {len(points)}\n{XYZ}{vertex}"
    head += f"element face {faces}\n{FACES}{face}end_header\n"
    path = folder / "a.ply"
    path.write_bytes(head.encode() + (body.encode() if isinstance(body, str) else body))
    return path


def rows(points, *more):
    """Return points as lines of text, each with further words."""
    return "".join(" ".join(map(str, (*point, *words))) + "\n" for point, *words in zip(points, *more, strict=True))


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_polygons_of_mixed_size(tmp_path, order):
    """A quadrilateral and a triangle are three triangles in either byte order."""
    body = b"".join(struct.pack(f"{order}3f", *point) for point in POINTS)
    body += b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in ((0, 1, 2, 3), (3, 2, 4)))
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    mesh = load_mesh(write(tmp_path, body, form=form))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    with pytest.raises(ValueError, match='ends within entry 1 of "face"'):
        load_mesh(write(tmp_path, body[:-1], form=form))


def test_colours_of_polygons(tmp_path):
    """Each triangle has the colour of its polygon; the others are not touched."""
    face = "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n"
    mesh = load_mesh(write(tmp_path, rows(POINTS) + "4 0 1 2 3 255 0 0 51\n3 3 2 4 0 0 255 255\n", face=face))
    np.testing.assert_array_equal(mesh.color[mesh.faces[:, 0]], [[1, 0, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(mesh.opacity[mesh.faces[:, 0]], [0.2, 0.2, 1.0])


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("uchar", (128, 0, 255), (HALF, 0, 1)),
        ("ushort", (6554, 13107, 52428), (0.01002, 0.03310, 0.60383)),
        ("float", (0.1, 0.2, 0.8), (0.01002, 0.03310, 0.60383)),
        ("float", (128.0, 0.0, 255.0), (HALF, 0, 1)),
        ("int", (128, 0, 255), (HALF, 0, 1)),
    ],
)
@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_colours_of_every_type(tmp_path, kind, values, expected, names):
    """Colours are shares of their type's largest, sRGB, of meshes and points alike."""
    vertex = "".join(f"property {kind} {name}\n" for name in names)
    path = write(tmp_path, rows(POINTS, *([v] * 5 for v in values)) + "3 0 1 2\n", vertex, faces=1)
    np.testing.assert_allclose(load_mesh(path).color[0], expected, atol=1e-5)
    np.testing.assert_allclose(load_points(path).color[0], expected, atol=1e-5)


def test_opacity_by_either_name(tmp_path):
    """`opacity` and `alpha` are the same; logarithms of odds under that name are named and left out."""
    for name in ("alpha", "opacity"):
        path = write(tmp_path, rows(POINTS, [0.25] * 5) + "3 0 1 2\n", f"property float {name}\n", faces=1)
        assert load_mesh(path).opacity.tolist() == [0.25] * 5
        assert load_points(path).opacity.tolist() == [0.25] * 5
    path = write(tmp_path, rows(POINTS, [-3.0] * 5) + "3 0 1 2\n", "property float opacity\n", faces=1)
    with pytest.warns(UserWarning, match="opacity: its values are not from 0 to 1, drawn without"):
        assert load_points(path).opacity is None


def test_coordinates_beside_colours(tmp_path):
    """Colours count where no image is named; with one, the image does, and coordinates lead to it."""
    vertex = "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float s\nproperty float t\n"
    body = rows(POINTS, [255] * 5, [0] * 5, [0] * 5, [0.5] * 5, [0.25] * 5) + "3 0 1 2\n"
    mesh = load_mesh(write(tmp_path, body, vertex, faces=1))
    np.testing.assert_array_equal(mesh.color, [[1, 0, 0]] * 5)
    assert mesh.textures == []
    np.testing.assert_array_equal(mesh.uv, [[0.5, 0.25]] * 5)
    Image.new("RGB", (2, 2), (0, 0, 255)).save(tmp_path / "blue.png")
    path = write(tmp_path, body, vertex, faces=1, comments="comment TextureFile blue.png\n")
    with pytest.warns(UserWarning, match="colours of vertices beside an image"):
        mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.textures[0][0, 0], [0, 0, 1, 1])
    np.testing.assert_array_equal(mesh.color, [1, 1, 1])


def test_coordinates_of_corners_and_numbers_of_images(tmp_path):
    """Corners have coordinates of their own, polygons the number of their image."""
    for name, color in (("a.png", (255, 0, 0)), ("b.png", (0, 255, 0))):
        Image.new("RGB", (1, 1), color).save(tmp_path / name)
    face = "property list uchar float texcoord\nproperty int texnumber\n"
    body = rows(POINTS) + "3 0 1 2 6 0 0 1 0 1 1 1\n3 3 2 4 6 0 0.5 1 0.5 0.5 1 0\n"
    comments = "comment TextureFile a.png\ncomment TextureFile b.png\n"
    mesh = load_mesh(write(tmp_path, body, face=face, comments=comments))
    assert mesh.texture_index.tolist() == [1, 0]
    np.testing.assert_array_equal(mesh.uv[mesh.faces[1]], [[0, 0.5], [1, 0.5], [0.5, 1]])


def test_strips(tmp_path):
    """Strips alternate their sense, −1 begins another one, empty triangles are left out."""
    head = f"ply\nformat ascii 1.0\nelement vertex 5\n{XYZ}element tristrips 1\n{FACES}end_header\n"
    path = tmp_path / "a.ply"
    path.write_text(head + rows(POINTS) + "9 0 1 3 2 2 -1 3 2 4\n")
    assert load_mesh(path).faces.tolist() == [[0, 1, 3], [3, 1, 2], [3, 2, 4]]


def test_doubles_keep_large_coordinates(tmp_path):
    """Coordinates of a map, hundreds of kilometres from its origin, keep their millimetres."""
    east, north = 448262.3, 5411932.7
    points = [(east, north, 0.0), (east + 1.0, north, 0.0), (east, north + 1.0, 0.0)]
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + XYZ.replace("float", "double")
    path = tmp_path / "a.ply"
    path.write_text(f"{head}element face 1\n{FACES}end_header\n" + rows(points) + "3 0 1 2\n")
    mesh = load_mesh(path)
    assert mesh.vertices.dtype == np.float64
    np.testing.assert_allclose(mesh.vertices - [east, north, 0], [[0, 0, 0], [1, 0, 0], [0, 1, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"plx\n", "no PLY header"),
        (b"ply\nformat ascii 2.0 x\nend_header\n", "which is not PLY's"),
        (b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n1 2\n", "ends within"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n", "ends"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n", "words among the numbers"),
    ],
)
def test_broken_files(data, words):
    """What a header promises and the file does not hold is refused before memory is taken for it."""
    with pytest.raises(ValueError, match=words):
        read_ply(data)
