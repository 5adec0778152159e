"""What is opened: regular files alone, of sane sizes and numbers; everything else is one line that names the file."""

import os
import socket
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from warpfrag.errors import SceneError
from warpfrag.files import pixels
from warpfrag.files.images import ImageError, read_image
from warpfrag.files.meshes import load_mesh
from warpfrag.files.points import load_points
from warpfrag.files.scene_file import load_scene
from warpfrag.files.source import ReadingWarning, read_regular

CAMERA = "[camera]\neye = [0, 0, 3]\ntarget = [0, 0, 0]\nfov = 45.0\n"


@pytest.mark.skipif(os.name != "posix", reason="pipes and sockets with names are those of POSIX")
@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "device", "loop"])
def test_only_regular_files_are_opened(tmp_path, kind, monkeypatch):
    """A pipe, a folder, a socket, a device or a loop of links in the place of a file is refused at once."""
    monkeypatch.chdir(tmp_path)
    readers = {"a.toml": load_scene, "a.ply": load_mesh, "a.usda": load_mesh, "a.xyz": load_points, "a.png": read_image}
    got = {"pipe": "a pipe", "folder": "a folder", "socket": "a socket", "device": "a device", "loop": "cannot be"}
    for name, reader in readers.items():
        if kind == "pipe":
            os.mkfifo(name)
        elif kind == "folder":
            os.mkdir(name)
        elif kind == "socket":
            socket.socket(socket.AF_UNIX).bind(name)
        else:
            os.symlink("/dev/zero" if kind == "device" else name, name)
        with pytest.raises(ValueError, match=rf"{name}.*{got[kind]}|{got[kind]}.*{name}") as caught:
            reader(name)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["mesh", "points", "texture"])
def test_names_that_cannot_be(tmp_path, key):
    """NUL, loops of links and names beyond any length are one line of the scene file."""
    os.symlink("b", tmp_path / "a")
    os.symlink("a", tmp_path / "b")
    start = '[[object]]\nprimitive = "plane"\n' if key == "texture" else "[[object]]\n"
    for name, words in (
        (r"x\u0000.png", "control characters"),
        ("a/x.png", "links|followed"),
        ("x" * 300, "followed|kind"),
    ):
        (tmp_path / "scene.toml").write_text(CAMERA + f'{start}{key} = "{name}"\n')
        with pytest.raises(SceneError, match=rf"scene.toml: object\[0\].{key}.*({words})"):
            load_scene(tmp_path / "scene.toml")


def test_sizes_are_judged_before_reading(tmp_path):
    """A sparse file of a terabyte is refused by its size."""
    path = tmp_path / "a.stl"
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(ValueError, match=f"got a file of {2**40} bytes at .*a.stl, expected at most"):
        load_mesh(path)
    (tmp_path / "b").write_bytes(b"12345")
    with pytest.raises(ValueError, match=r"got a file of 5 bytes .*, expected at most 4"):
        read_regular(tmp_path / "b", "a file", 4)


NUMBERS = {
    "thickness": ("thickness = 1e300\n", "thickness.*got 1e.300, expected a number from 0 to 3.4"),
    "radius": ("radius = 1e39\n", "radius.*got 1e.39"),
    "translate": ("translate = [1e308, 0, 0]\n", "translate.*got .1e.308.*expected 3 numbers"),
    "scale": ("scale = 1e39\n", "scale.*got 1e.39"),
    "digits": (f"opacity = {'9' * 400}\n", "opacity.*got a whole number of about 400 digits, expected a number"),
    "segments": (f"segments = {'9' * 400}\n", "segments.*got a whole number of about 400 digits"),
    "thousands": (f"opacity = {'9' * 5000}\n", "got what cannot be read .a number of too many digits"),
    "nested": (f"color = {'[' * 5000}{']' * 5000}\n", "cannot be read|not TOML"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_beyond_all_measure(tmp_path, case):
    """What float32 does not hold, and digits by the hundreds, are refused with the key and what stands there."""
    text, words = NUMBERS[case]
    (tmp_path / "scene.toml").write_text(CAMERA + '[[object]]\nprimitive = "sphere"\n' + text)
    with pytest.raises(SceneError, match=words) as caught:
        load_scene(tmp_path / "scene.toml")
    assert str(caught.value).startswith(f"{tmp_path / 'scene.toml'}: ")
    assert len(str(caught.value)) < 400


def test_vertices_beyond_float32(tmp_path):
    """A vertex that float32 does not hold is refused."""
    (tmp_path / "a.obj").write_text("v 1e39 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"a vertex is at 1e.39"):
        load_mesh(tmp_path / "a.obj")


def test_a_byte_order_mark_is_let_through(tmp_path):
    """Editors put one before UTF-8; neither scenes nor points mind."""
    (tmp_path / "a.toml").write_text("\ufeff" + CAMERA + '[[object]]\nprimitive = "cube"\n', encoding="utf-8")
    assert len(load_scene(tmp_path / "a.toml").objects) == 1
    (tmp_path / "a.pts").write_text("\ufeff2\n1 2 3\n4 5 6\n1\n7 8 9\n", encoding="utf-8")
    np.testing.assert_array_equal(load_points(tmp_path / "a.pts").points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])


def png_header(width, height):
    """Return a PNG file that promises so many pixels and holds a few bytes."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")


def test_images_are_judged_by_their_headers(tmp_path, monkeypatch):
    """What would unpack to more pixels than the limit is refused before it is unpacked, as a reference or a texture."""
    (tmp_path / "a.png").write_bytes(png_header(60000, 60000))
    words = rf"a.png: got 60000 × 60000 pixels, expected from 1 to {pixels.MOST_PIXELS} of them"
    with pytest.raises(ImageError, match=words):
        read_image(tmp_path / "a.png")
    (tmp_path / "s.toml").write_text(CAMERA + '[[object]]\nprimitive = "plane"\ntexture = "a.png"\n')
    with pytest.raises(SceneError, match=words):
        load_scene(tmp_path / "s.toml")
    np.save(tmp_path / "a.npy", np.zeros((4, 3, 4), "f4"))
    Image.new("RGB", (4, 3)).save(tmp_path / "a.jpg")
    monkeypatch.setattr("warpfrag.files.pixels.check_pixels.__defaults__", (11,))
    for name in ("a.npy", "a.jpg"):
        with pytest.raises(ImageError, match=f"{name}: got"):
            read_image(tmp_path / name)


def test_a_missing_image_of_a_mesh_leaves_the_mesh(tmp_path):
    """A pipe that a material names is not opened; the mesh is drawn without the image, with one warning."""
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd a.png\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")
    with pytest.warns(ReadingWarning, match="cannot find a.png"):
        assert load_mesh(tmp_path / "a.obj").textures == []
