"""Scene files: what they mean, and one line for each thing that can be wrong with them."""

import os
from pathlib import Path

import numpy as np
import pytest
from gltf_files import write_gltf
from PIL import Image

from warpfrag.errors import SceneError
from warpfrag.files.scene_file import load_scene
from warpfrag.scene.assemble import assemble
from warpfrag.scene.light import Light

SCENES = sorted((Path(__file__).parents[2] / "scenes").glob("*.toml"))
CAMERA = "[camera]\neye = [0, 0, 3]\ntarget = [0, 0, 0]\nfov = 45.0\n"
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def write(folder, text, name="scene.toml"):
    """Write a file, its folder too, and return its path."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def objects(folder, body, head=""):
    """Return the objects of a scene with a camera."""
    return load_scene(write(folder, head + CAMERA + body)).objects


def only(folder, keys, head=""):
    """Return the one object of a scene that has a sphere with these keys."""
    (item,) = objects(folder, '[[object]]\nprimitive = "sphere"\nsegments = 8\n' + keys, head)
    return item


def test_a_whole_scene(tmp_path):
    """Globals, camera and objects arrive as written, in their own units."""
    write(tmp_path, TRIANGLE, "tri.obj")
    head = 'beta = 0.5\nlayers = 4\nmerge = "none"\nmix = "average"\nbackground = [1.0, 0.5, 0, 0.5]\n'
    body = (
        '[[object]]\nmesh = "tri.obj"\nopacity = 0.25\nthickness = 0.05\ncolor = [0.9, 0.6, 0.3]\n'
        '[[object]]\nprimitive = "cube"\nsize = 2\nthickness = "3.5P"\ncolor = "#80ff00"\n'
    )
    scene = load_scene(write(tmp_path, head + CAMERA + body))
    assert (scene.beta, scene.layers, scene.merge, scene.mix) == (0.5, 4, "none", "average")
    assert scene.background == (0.5, 0.25, 0.0, 0.5)
    assert (scene.camera.eye, scene.camera.fov, scene.camera.size) == ((0, 0, 3), 45, (512, 512))
    first, second = scene.objects
    assert (first.name, first.opacity, first.thickness, first.thickness_unit) == ("tri", 0.25, 0.05, "scene")
    np.testing.assert_allclose(first.color, [0.9, 0.6, 0.3], rtol=1e-6)
    assert first.shade is None
    assert (second.name, second.opacity, second.thickness, second.thickness_unit) == ("cube", 1.0, 3.5, "P")
    # 0x80/255 in sRGB is 0.2158605 in linear light.
    np.testing.assert_allclose(second.color, [0.2158605, 1.0, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(np.abs(second.vertices), np.ones((24, 3)))


def test_defaults(tmp_path):
    """An object says only what it is: 0.8 grey, opaque, 2P, in place."""
    item = only(tmp_path, "")
    np.testing.assert_allclose(item.color, [0.8] * 3, rtol=1e-6)
    assert (item.opacity, item.thickness, item.thickness_unit) == (1.0, 2.0, "P")
    np.testing.assert_array_equal(item.matrix, np.eye(4))


def test_transforms_scale_then_rotate_then_translate(tmp_path):
    """A point is scaled, turned by each rotation in order, and moved: worked by hand."""
    turn = "rotate = [{ axis = [0, 0, 2], degrees = 90 }, { axis = [1, 0, 0], degrees = 90 }]\n"
    item = only(tmp_path, "scale = [2, 3, 4]\n" + turn + "translate = [10, 20, 30]\n")
    # (1, 0, 0) -> (2, 0, 0) -> (0, 2, 0) -> (0, 0, 2) -> (10, 20, 32)
    np.testing.assert_allclose(item.matrix @ [1, 0, 0, 1], [10, 20, 32, 1], atol=1e-12)
    item = only(tmp_path, "matrix = [[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]]\n")
    np.testing.assert_array_equal(item.matrix @ [0, 1, 0, 1], [5, 6, 8, 1])


def light_on(folder, body: str, head: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the factor of light on each vertex of a scene's only object, and the vertices' own z."""
    scene = load_scene(write(folder, head + CAMERA + '[[object]]\nprimitive = "sphere"\n' + body))
    (item,) = scene.objects
    return assemble(scene).rgba[:, 0] / np.float32(item.color[0]), item.vertices[:, 2]


def test_light_is_a_factor_per_vertex(tmp_path):
    """A light along z: the poles of a sphere get the ambient part alone, its front and back the full colour."""
    found, z = light_on(tmp_path, "", "[light]\ndirection = [0, 0, 2]\nambient = 0.25\n")
    np.testing.assert_allclose(found, 0.25 + 0.75 * np.abs(z), atol=1e-6)
    found, z = light_on(tmp_path, "translate = [0, 0, -50]\n", '[light]\ndirection = "camera"\n')
    np.testing.assert_allclose(found, 0.3 + 0.7 * np.abs(z), atol=0.03)


def test_flat_normals_split_the_vertices(tmp_path):
    """With `normals = "flat"` the three corners of a face have one factor and belong to it alone."""
    item = only(tmp_path, 'normals = "flat"\n')
    assert len(item.vertices) == 3 * len(item.faces)
    assert np.ptp(item.normals.reshape(-1, 3, 3), axis=1).max() == 0.0
    cube = 'primitive = "cube"\nname = "{}"\n'
    light = Light((1, 2, 3))
    sharp, smooth = objects(
        tmp_path, "[[object]]\n" + cube.format("a") + "[[object]]\n" + cube.format("b") + 'normals = "smooth"\n'
    )
    for each, count in ((sharp, 3), (smooth, 4)):
        factor = light.factor(each.normals, each.world_vertices(), load_scene(tmp_path / "scene.toml").camera)
        assert len(np.unique(factor.round(6))) == count


def test_texture_key(tmp_path):
    """An image gets linear, is tinted by the colour, and gives a primitive its texture coordinates."""
    Image.fromarray(np.array([[[255, 128, 0, 51]]], dtype=np.uint8)).save(tmp_path / "dot.png")
    item = only(tmp_path, 'texture = "dot.png"\n')
    np.testing.assert_allclose(item.texture, [[[1.0, 0.2158605, 0.0, 0.2]]], rtol=1e-6)
    np.testing.assert_array_equal(item.color, [1, 1, 1])
    assert item.uv.shape == (len(item.vertices), 2)
    assert only(tmp_path, 'texture = "dot.png"\ncolor = [0.5, 1, 1]\nopacity = 0.5\n').opacity == 0.5


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_shipped_scenes_load(path):
    """Every scene that comes with the project can be read, is lit, and fits into its image."""
    if "usd" in path.read_text():
        pytest.importorskip("pxr", reason="usd-core is not installed")
    scene = load_scene(path)
    assert path.read_text().startswith("# ")
    assert scene.camera.size == (512, 512)
    assert scene.light is not None
    for item in scene.objects:
        assert item.normals is not None
        x, y, z = (np.c_[item.world_vertices(), np.ones(len(item.vertices))] @ scene.camera.view_matrix().T).T[:3]
        assert z.min() > scene.camera.near
        assert z.max() < scene.camera.far
        # From scene units, at this depth, to pixels.
        scale = scene.camera.focal / z if scene.camera.is_perspective else 512 / scene.camera.height
        assert np.abs(x * scale).max() < 256
        assert np.abs(y * scale).max() < 256


BALL = '[[object]]\nname = "ball"\nprimitive = "sphere"\n'
COMPLAINTS = {
    "syntax": ("beta = 0.5\neye = = 1\n", "line 2: got what is not TOML"),
    "open end": ("beta = [0.5\n", "line 1: got what is not TOML"),
    "no camera": (BALL, "camera: got none"),
    "no objects": (CAMERA, r"object: got none, expected one or more tables headed \[\[object\]\]"),
    "one object": (CAMERA + '[object]\nname = "x"\n', "object: got one table"),
    "top key": ("bta = 1\n" + CAMERA + BALL, 'bta: got an unknown key; did you mean "beta"?'),
    "camera key": (CAMERA + "foov = 3\n" + BALL, r'camera.foov: got an unknown key; did you mean "fov"\?'),
    "camera eye": ("[camera]\ntarget = [0, 0, 0]\nfov = 1\n" + BALL, "camera.eye: got none, expected 3 numbers"),
    "camera both": (CAMERA + "height = 2.0\n" + BALL, "camera: .* both of fov and height"),
    "near far": (CAMERA + "near = 5\nfar = 1\n" + BALL, "camera.far: .* 1"),
    "size": (CAMERA + "size = [512.0, 512]\n" + BALL, "camera.size: got .*two whole numbers"),
    "huge size": (CAMERA + "size = [1000000, 512]\n" + BALL, "camera.size"),
    "beta range": ("beta = 1.5\n" + CAMERA + BALL, "beta: got 1.5, expected a number from 0 to 1"),
    "beta nan": ("beta = nan\n" + CAMERA + BALL, "beta: got nan"),
    "beta bool": ("beta = true\n" + CAMERA + BALL, "beta: got true, expected a number from 0 to 1"),
    "layers": ("layers = 0\n" + CAMERA + BALL, "layers: got 0, expected a whole number from 1 to"),
    "merge": ('merge = "smoth"\n' + CAMERA + BALL, r'merge: got "smoth", expected one of .*did you mean "smooth"\?'),
    "background": (
        'background = "white"\n' + CAMERA + BALL,
        r'background: got "white", expected 3 numbers .*#rrggbb',
    ),
    "light": (CAMERA + "[light]\ndirection = [0, 0, 0]\n" + BALL, "light.direction"),
    "ambient": (CAMERA + "[light]\nambient = -1\n" + BALL, "light.ambient: got -1"),
    "no shape": (
        CAMERA + '[[object]]\nname = "x"\n',
        r'object\[0\] of "x": got no shape, expected mesh, primitive or points',
    ),
    "both": (CAMERA + BALL + 'mesh = "a.obj"\n', "got both mesh and primitive"),
    "primitive": (CAMERA + '[[object]]\nprimitive = "spere"\n', r'object\[0\].primitive: .*did you mean "sphere"\?'),
    "other size": (CAMERA + BALL + "tube = 1\n", 'tube of "ball": got an unknown key of primitive "sphere"'),
    "object key": (CAMERA + BALL + "opacty = 1\n", r'object\[0\].opacty of "ball": .*did you mean "opacity"\?'),
    "opacity": (
        CAMERA + BALL + "opacity = 1.5\n",
        r'object\[0\].opacity of "ball": got 1.5, expected a number from 0',
    ),
    "radius": (CAMERA + BALL + "radius = -1\n", "radius.*got -1, expected a number above 0"),
    "radius text": (CAMERA + BALL + 'radius = "1"\n', 'radius.*got "1", expected a number above 0'),
    "segments": (CAMERA + BALL + "segments = 2\n", "segments.*got 2, expected a whole number from 3"),
    "thickness": (CAMERA + BALL + "thickness = -1\n", 'thickness.*got -1, expected a number of at least 0, or .*"2P"'),
    "thickness text": (CAMERA + BALL + 'thickness = "-2P"\n', 'thickness.*got "-2P"'),
    "thickness inf": (CAMERA + BALL + "thickness = inf\n", "thickness.*got inf"),
    "color": (CAMERA + BALL + "color = [1, 2, 3]\n", "color.*expected 3 numbers from 0 to 1"),
    "color hex": (CAMERA + BALL + 'color = "#12345"\n', 'color.*got "#12345"'),
    "scale": (CAMERA + BALL + "scale = 0\n", "scale.*got 0, expected a number other than 0"),
    "rotate": (CAMERA + BALL + "rotate = { axis = [0, 0, 0], degrees = 1 }\n", "rotate.*axis other than 0"),
    "rotate key": (CAMERA + BALL + "rotate = { axis = [0, 0, 1], degree = 1 }\n", 'rotate.degree.*"degrees"'),
    "matrix": (CAMERA + BALL + "matrix = [[1, 0], [0, 1]]\n", "matrix.*expected 4 rows of 4 numbers"),
    "matrix flat": (CAMERA + BALL + f"matrix = {[[1, 0, 0, 0]] * 3 + [[0, 0, 0, 1]]}\n", "matrix.*invertible"),
    "matrix too": (CAMERA + BALL + f"scale = 1\nmatrix = {np.eye(4).tolist()}\n", "matrix.*got scale as well"),
    "same name": (CAMERA + BALL + BALL, r'object\[1\].name: got "ball", which object\[0\] has too'),
    "camera name": (
        CAMERA + '[[object]]\nname = "camera"\nprimitive = "cube"\n',
        r'object\[0\].name: got "camera", expected another',
    ),
    "blank name": (CAMERA + '[[object]]\nname = ""\nprimitive = "cube"\n', "name.*not blank"),
    "normals": (CAMERA + BALL + 'normals = "smoth"\n', "normals.*did you mean"),
    "no mesh": (CAMERA + '[[object]]\nmesh = "trii.obj"\n', r'mesh: got no such file at .*did you mean "tri.obj"'),
    "kind": (CAMERA + '[[object]]\nmesh = "scene.toml"\n', r"mesh: got the mesh file .* of an unknown kind.*\.ply"),
    "asset": (
        CAMERA + '[[object]]\nmesh = "warp:buny.usd"\n',
        r'mesh: got no "buny.usd".*did you mean "bunny.usd"\?',
    ),
    "empty mesh": (CAMERA + '[[object]]\nmesh = "points.obj"\n', "mesh: got no faces in"),
    "broken mesh": (CAMERA + '[[object]]\nmesh = "broken.ply"\n', "mesh: got a ply file that cannot be read"),
    "texture": (CAMERA + BALL + 'texture = "no.png"\n', "texture.*got no such file"),
    "texture kind": (CAMERA + BALL + 'texture = "tri.obj"\n', "texture.*an image that cannot be read"),
    "no uv": (CAMERA + '[[object]]\nmesh = "tri.obj"\ntexture = "a.png"\n', "texture.*without texture coordinates"),
}


@pytest.mark.parametrize("case", COMPLAINTS)
def test_complaints(tmp_path, case):
    """One line: the file, the key, what was got, what is expected."""
    write(tmp_path, TRIANGLE, "tri.obj")
    write(tmp_path, "v 0 0 0\nv 1 1 1\n", "points.obj")
    write(tmp_path, "ply\nformat ascii 1.0\nelement vertex 3\nnonsense\n", "broken.ply")
    text, words = COMPLAINTS[case]
    path = write(tmp_path, text)
    with pytest.raises(SceneError, match=words) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


def test_missing_scene_file(tmp_path):
    """A scene that is not there is named."""
    with pytest.raises(SceneError, match=r"nothing.toml: got no such file"):
        load_scene(tmp_path / "nothing.toml")
    (tmp_path / "bytes.toml").write_bytes(b"beta = \xff")
    with pytest.raises(SceneError, match="not UTF-8"):
        load_scene(tmp_path / "bytes.toml")


@pytest.mark.parametrize("way", ["dots", "link", "folder link", "texture"])
def test_relative_paths_stay_inside(tmp_path, way):
    """A relative path out of the scene's folder is refused, through '..' as through links; an absolute one is not."""
    outside = write(tmp_path / "outside", TRIANGLE, "tri.obj")
    folder = tmp_path / "inside"
    folder.mkdir()
    if way == "link":
        os.symlink(outside, folder / "tri.obj")
    if way == "folder link":
        os.symlink(outside.parent, folder / "below")
    text = {"dots": "../outside/tri.obj", "link": "tri.obj", "folder link": "below/tri.obj", "texture": "../a.png"}[way]
    keys = f'primitive = "plane"\ntexture = "{text}"\n' if way == "texture" else f'mesh = "{text}"\n'
    with pytest.raises(SceneError, match=r"outside of .*expected a file in it or below, or an absolute path"):
        objects(folder, "[[object]]\n" + keys)
    assert len(objects(folder, f'[[object]]\nmesh = "{outside}"\n')[0].faces) == 1


def test_paths_below_and_through_the_folder_are_fine(tmp_path):
    """Folders below, and '..' that comes back, are inside; a scene reached by a linked folder reads beside itself."""
    write(tmp_path / "real", "")
    write(tmp_path / "real" / "sub", TRIANGLE, "tri.obj")
    os.symlink(tmp_path / "real", tmp_path / "alias")
    for text in ("sub/tri.obj", "sub/../sub/tri.obj"):
        assert objects(tmp_path / "alias", f'[[object]]\nmesh = "{text}"\n')[0].name == "tri"


def two_nodes(folder, **names):
    """Write a glTF of two triangles under two nodes, one above the other."""
    face = np.array([0, 1, 2], "u2")
    nodes = [{"mesh": 0, "name": "box"}, {"mesh": 0, "name": "lid", "translation": [0, 0, 1]}]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
    return write_gltf(folder, [triangle, face], primitive, nodes=nodes, scenes=[{"nodes": [0, 1]}], **names)


def test_nodes_are_objects_of_their_own(tmp_path):
    """With `split` each node is an object with its name, and may have a thickness of its own."""
    two_nodes(tmp_path)
    keys = '[[object]]\nmesh = "a.gltf"\nsplit = "nodes"\ntranslate = [5, 0, 0]\n'
    box, lid = objects(tmp_path, keys + 'thickness = { box = 0.25, lid = "3P" }\n')
    assert (box.name, box.thickness, box.thickness_unit) == ("box", 0.25, "scene")
    assert (lid.name, lid.thickness, lid.thickness_unit) == ("lid", 3.0, "P")
    np.testing.assert_allclose(lid.world_vertices()[0], [5, 0, 1])
    assert [item.name for item in objects(tmp_path, keys + 'name = "case"\n')] == ["case.box", "case.lid"]
    with pytest.raises(SceneError, match=r'thickness.lit: got an unknown name, .*did you mean "lid"'):
        objects(tmp_path, keys + "thickness = { lit = 1 }\n")
    (whole,) = objects(tmp_path, '[[object]]\nmesh = "a.gltf"\n')
    assert (whole.name, len(whole.faces)) == ("a", 2)


def test_groups_are_objects_of_their_own(tmp_path):
    """Groups of an obj file likewise; what has no name has that of the file."""
    write(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ng left\nf 1 2 3\ng right\nf 3 2 1\n", "tri.obj")
    items = objects(tmp_path, '[[object]]\nmesh = "tri.obj"\nsplit = "groups"\nthickness = 0.5\n')
    assert [(item.name, item.thickness) for item in items] == [("tri", 0.5), ("left", 0.5), ("right", 0.5)]


def test_objects_that_nobody_has_named_are_numbered(tmp_path):
    """Two spheres without names are told apart; a name that is given twice is refused."""
    items = objects(tmp_path, '[[object]]\nprimitive = "sphere"\n' * 2 + '[[object]]\nprimitive = "cube"\n')
    assert [item.name for item in items] == ["sphere", "sphere 2", "cube"]
