"""Scenes made in Python: shapes, files and points as objects."""

import doctest
import importlib

import numpy as np
import pytest

import warpfrag as wf

SCENE = """
background = [1, 1, 1]
[light]
direction = [1, 2, 1]
[camera]
eye = [0, 1, 3]
target = [0, 0, 0]
fov = 45
size = [32, 24]
[[object]]
name = "ball"
primitive = "sphere"
radius = 0.5
color = [0.9, 0.2, 0.1]
opacity = 0.5
thickness = 0.1
translate = [0.1, 0.2, 0.3]
scale = [1, 2, 1]
[[object]]
name = "floor"
primitive = "plane"
size = 4
rotate = { axis = [1, 0, 0], degrees = -90 }
translate = [0, -0.5, 0]
texture = "checks.png"
color = [0.5, 0.6, 0.7]
"""


@pytest.mark.parametrize("place", ["scene.scene.Scene", "shapes.mesh.Mesh.object", "shapes.surfels.surfels",
                                   "arrays.devices.check_device"])  # fmt: skip
def test_examples_of_docstrings_run(place):
    """They give what they say."""
    module, _, name = place.rpartition(".")
    owner = None
    if module.endswith("Mesh"):
        module, _, owner = module.rpartition(".")
    home = importlib.import_module(f"warpfrag.{module}")
    found = getattr(getattr(home, owner) if owner else home, name)
    runner = doctest.DocTestRunner()
    tests = doctest.DocTestFinder(recurse=False).find(found, name, globs={"wf": wf, "np": np, **vars(home)})
    assert sum(len(test.examples) for test in tests) > 0
    assert sum(runner.run(test).failed for test in tests) == 0


def test_scene_in_python_is_that_of_a_file(tmp_path):
    """Shapes, places, looks, light and textures: the same objects as from a file, and the same image."""
    checks = np.zeros((2, 2, 4), np.float32)
    checks[..., 3] = 1.0
    checks[[0, 1], [0, 1], :3] = 1.0
    wf.write_image(tmp_path / "checks.png", checks)
    (tmp_path / "scene.toml").write_text(SCENE)
    from_file = wf.load_scene(tmp_path / "scene.toml")
    ball = wf.shapes.sphere(0.5).object(
        "ball", color=(0.9, 0.2, 0.1), opacity=0.5, thickness=0.1, translate=(0.1, 0.2, 0.3), scale=(1, 2, 1)
    )
    floor = wf.shapes.plane((4, 4)).object(
        "floor", color=(0.5, 0.6, 0.7), texture=wf.shapes.read_texture(tmp_path / "checks.png"), rotate=(-90, 0, 0),
        translate=(0, -0.5, 0),
    )  # fmt: skip
    camera = wf.Camera.look_at((0, 1, 3), (0, 0, 0), fov=45.0, size=(32, 24))
    made = wf.Scene(camera, [ball, floor], light=wf.Light((1, 2, 1)), background=(1, 1, 1, 1))
    for one, other in zip(made.objects, from_file.objects, strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-12)
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.normals, other.normals)
    np.testing.assert_allclose(wf.render(made), wf.render(from_file), atol=1e-5)


def test_mesh_files_and_points_are_objects(tmp_path):
    """A file's colours stay unless others are given; normals that it lacks are smooth; points become discs."""
    (tmp_path / "two.obj").write_text("g lid\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ng box\nv 0 0 1\nf 1 2 4\n")
    whole = wf.shapes.load_mesh(tmp_path / "two.obj").object("both", opacity=0.25)
    assert len(whole.faces) == 2
    assert whole.opacity == 0.25
    np.testing.assert_allclose(np.linalg.norm(whole.normals, axis=1), 1.0)
    parts = wf.shapes.load_parts(tmp_path / "two.obj")
    assert [part.object(part.name).name for part in parts] == ["lid", "box"]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    cloud = wf.shapes.surfels(points, segments=6).object("cloud", thickness="10P")
    assert len(cloud.faces) == 200
    assert (cloud.thickness, cloud.thickness_unit) == (10.0, "P")
    colors = np.tile(np.repeat(points, 6, axis=0) * 0.5 + 0.5, 1)
    np.testing.assert_allclose(wf.shapes.surfels(points, segments=6).object("c", color=colors).color, colors, rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"translate": (1, 2)}, r"box\.translate: got \(1, 2\), expected 3 numbers"),
        ({"scale": 0.0}, r"box\.matrix: got .* expected finite numbers, invertible"),
        ({"rotate": (0, float("nan"), 0)}, r"box\.rotate: got nan, expected a finite number"),
        ({"texture": np.zeros((2, 2))}, r"box\.texture: got shape \(2, 2\), expected shape \(h, w, 3\) or"),
        ({"opacity": 2.0}, r"box\.opacity: got 2, expected numbers from 0 to 1"),
        ({"thickness": "2Q"}, r'box\.thickness: got "2Q", expected a number, or multiples'),
    ],
)
def test_arguments_are_checked(options, message):
    """Each is named with its object."""
    with pytest.raises(ValueError, match=message):
        wf.shapes.cube().object("box", **options)
    with pytest.raises(ValueError, match=r"ball\.texture: got an image but no uv, expected uv as well"):
        wf.shapes.sphere().object("ball", texture=np.zeros((2, 2, 3)))


def test_every_name_exists():
    """What the room offers can be had."""
    for name in wf.shapes.__all__:
        assert callable(getattr(wf.shapes, name))
        assert name in dir(wf.shapes)
    with pytest.raises(AttributeError, match="shapes' has no attribute 'pyramid'"):
        _ = wf.shapes.pyramid


def test_reprs_are_short():
    """Meshes, points and renderers say how large they are, not what is in them."""
    scene = wf.load_scene("example:three_spheres")
    assert repr(wf.shapes.cube()) == "Mesh(24 vertices, 12 faces)"
    assert repr(wf.shapes.PointSet(np.zeros((4, 3)))) == "PointSet(4 points)"
    assert repr(wf.Renderer(scene)) == f"Renderer({scene!r}, 512 × 512, sorted)"
