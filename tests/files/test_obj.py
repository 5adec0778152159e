"""OBJ and MTL files: corners, materials and their maps, groups, colours of vertices."""

import numpy as np
import pytest
from gltf_files import looked_up
from PIL import Image

from warpfrag.colors import encode
from warpfrag.files.meshes import load_mesh, load_parts

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
HALF = 0.21586050011389926  # 128/255 in sRGB, in linear light


@pytest.fixture
def ramp(tmp_path):
    """The folder, with an image of red 40, 100, 160, 220 from left to right."""
    pixels = np.zeros((4, 4, 3), "u1")
    pixels[..., 0] = np.arange(4) * 60 + 40
    Image.fromarray(pixels).save(tmp_path / "ramp.png")
    Image.fromarray(pixels).save(tmp_path / "my own.png")
    return tmp_path


def write(folder, text, materials=None):
    """Write an OBJ file, and its library if there is one."""
    if materials is not None:
        (folder / "a.mtl").write_text(materials)
        text = "mtllib a.mtl\n" + text
    path = folder / "a.obj"
    path.write_text(text)
    return path


def reds(mesh):
    """Return the stored red at the middles of four columns of a square."""
    rgba = looked_up(mesh, [(2.0 * (column + 0.5) / 4 - 1.0, 0.1) for column in range(4)])
    return encode(rgba[None, :, :3])[0, :, 0].tolist()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("ramp.png", [40, 100, 160, 220]),
        ("my own.png", [40, 100, 160, 220]),
        ("-o 0.5 0 0 -s 1 1 1 -clamp off ramp.png", [160, 220, 40, 100]),
        ("-o 0.5 my own.png", [160, 220, 40, 100]),
        ("-clamp on -o 0.5 ramp.png", [160, 220, 220, 220]),
        ("-s -1 1 1 -blendu on -texres 512 ramp.png", [220, 160, 100, 40]),
    ],
)
def test_options_of_maps(ramp, options, expected):
    """Coordinates are scaled, shifted and clamped; names may have blanks."""
    mesh = load_mesh(write(ramp, SQUARE + UV + "usemtl a\n" + FACE, f"newmtl a\nKd 1 1 1\nmap_Kd {options}\n"))
    assert reds(mesh) == expected


def test_options_that_are_left_out_are_named(ramp):
    """Turbulence and contrast are named, unless they say nothing."""
    library = "newmtl a\nmap_Kd -mm 0.2 2 -t 0 0 0 ramp.png\n"
    with pytest.warns(UserWarning, match=r"texture: the option -mm is not supported, drawn without$"):
        load_mesh(write(ramp, SQUARE + UV + "usemtl a\n" + FACE, library))


def test_maps_of_opacity(ramp):
    """map_d gives opacity by its grey as stored, or by its own opacity, with and without map_Kd."""
    Image.fromarray(np.array([[0, 51, 102, 255]], "u1")).save(ramp / "grey.png")
    text = SQUARE + UV + "usemtl a\n" + FACE
    mesh = load_mesh(write(ramp, text, "newmtl a\nKd 1 0 0\nd 0.5\nmap_Kd ramp.png\nmap_d grey.png\n"))
    np.testing.assert_allclose(mesh.textures[0][0, :, 3], [0, 0.2, 0.4, 1], atol=1e-6)
    assert mesh.opacity == 0.5
    assert mesh.textures[0].shape == (4, 4, 4)
    mesh = load_mesh(write(ramp, text, "newmtl a\nKd 1 0 0\nmap_d grey.png\n"))
    np.testing.assert_allclose(mesh.textures[0][0], [[1, 1, 1, a] for a in (0, 0.2, 0.4, 1)], atol=1e-6)
    np.testing.assert_array_equal(mesh.color, [1, 0, 0])


def test_several_libraries_in_one_line(tmp_path):
    """`mtllib` may name several files; a name with a blank is one where there is such a file."""
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "b c.mtl").write_text("newmtl b\nKd 0 1 0\n")
    (tmp_path / "d.mtl").write_text("newmtl d\nKd 0 0 1\n")
    names = "mtllib a.mtl d.mtl\nmtllib b c.mtl\n"
    mesh = load_mesh(write(tmp_path, names + SQUARE + "usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\nusemtl d\nf 1 2 4\n"))
    np.testing.assert_array_equal(mesh.color[mesh.faces[:, 0]], np.eye(3))


def test_grey_of_one_number(tmp_path):
    """`Kd x` is grey; a colour of another kind is named."""
    mesh = load_mesh(write(tmp_path, SQUARE + "usemtl a\nf 1 2 3\n", f"newmtl a\nKd {128 / 255}\n"))
    np.testing.assert_allclose(mesh.color, [HALF] * 3)
    with pytest.warns(UserWarning, match='a colour "Kd spectral x.rfl" is not supported'):
        load_mesh(write(tmp_path, SQUARE + "usemtl a\nf 1 2 3\n", "newmtl a\nKd spectral x.rfl\n"))


def test_colours_of_vertices_beside_a_material(tmp_path):
    """Colours after positions stay, tinted by the material's."""
    text = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 1 1\n"
    mesh = load_mesh(write(tmp_path, text + "usemtl a\nf 1 2 3\n", "newmtl a\nKd 1 1 1\nd 0.5\n"))
    np.testing.assert_array_equal(mesh.color, [[1, 0, 0], [1, 0, 0], [1, 1, 1]])
    assert mesh.opacity == 0.5
    np.testing.assert_array_equal(load_mesh(write(tmp_path, text + "f 1 2 3\n")).color[2], [1, 1, 1])


def test_a_face_without_coordinates_leaves_the_others_their_image(ramp):
    """It alone is drawn without the image, in the material's colour."""
    library = "newmtl a\nKd 1 1 1\nmap_Kd ramp.png\n"
    mesh = load_mesh(write(ramp, SQUARE + UV + "usemtl a\nf 1/1 2/2 3/3\nf 1 3 4\n", library))
    assert mesh.texture_index.tolist() == [0, -1]
    assert len(mesh.textures) == 1


def test_groups_are_parts(tmp_path):
    """Each group, or object, is a part with its name; together they are the whole file."""
    text = SQUARE + "g left\nf 1 2 3\ng right\nf 1 3 4\ng left\nf 2 3 4\n"
    left, right = load_parts(write(tmp_path, text))
    assert (left.name, right.name) == ("left", "right")
    assert (len(left.faces), len(right.faces)) == (2, 1)
    assert len(right.vertices) == 3
    assert len(load_mesh(write(tmp_path, text)).vertices) == 4
    parts = load_parts(write(tmp_path, SQUARE + "o one\nf 1 2 3\no two\nf 1 3 4\n"))
    assert [part.name for part in parts] == ["one", "two"]


def test_corners_count_from_either_end(tmp_path):
    """Negative numbers count back from the face; normals and coordinates are those of the corner."""
    text = SQUARE + "vn 0 0 1\nvn 0 1 0\nf -4//1 -3//1 -2//2\nv 5 5 5\nf -5 -2 -1\n"
    mesh = load_mesh(write(tmp_path, text))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces[0]], [[-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(mesh.vertices[mesh.faces[1]], [[-1, -1, 0], [-1, 1, 0], [5, 5, 5]])
    np.testing.assert_array_equal(mesh.normals[mesh.faces[0]], [[0, 0, 1], [0, 0, 1], [0, 1, 0]])


def test_lines_comments_and_continuations(tmp_path):
    """Lines may be continued and commented; what is no surface is named."""
    text = "  v 0 0 0 # first\nv\t1 0 0\nv 0 1 \\\n0\nf 1 2 \\\n 3 # face\nl 1 2\n"
    with pytest.warns(UserWarning, match="lines are not drawn$"):
        assert load_mesh(write(tmp_path, text)).faces.tolist() == [[0, 1, 2]]


def test_coordinates_that_are_not_there(tmp_path):
    """Faces that name coordinates or normals beyond the file's are drawn without; positions have to be there."""
    with pytest.warns(UserWarning, match="some faces name coordinates that are not there, drawn without"):
        assert len(load_mesh(write(tmp_path, SQUARE + "f 1/7 2/8 3/9\n")).faces) == 1
    with pytest.raises(ValueError, match="a face names vertex 7, there are 4"):
        load_mesh(write(tmp_path, SQUARE + "f 1 2 7\n"))


def test_materials_that_are_invisible_are_named(tmp_path):
    """`Tr 1` is fully transparent, whatever the program that wrote it meant."""
    with pytest.warns(UserWarning, match='a material of "Tr 1.0" is invisible'):
        assert load_mesh(write(tmp_path, SQUARE + "usemtl a\nf 1 2 3\n", "newmtl a\nTr 1.0\n")).opacity == 0.0
