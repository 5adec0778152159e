"""Surfels: files of points, estimated normals, discs, and scenes that have them."""

import numpy as np
import pytest

import warpfrag as wf
from warpfrag.files.points import load_points
from warpfrag.scene.assemble import assemble
from warpfrag.shapes.surfels import PointSet, estimate_normals, spacing, surfels

HALF = 0.21586050011389926  # 128/255 in sRGB, in linear light
CAMERA = "[camera]\neye = [0, 0, 3]\ntarget = [0, 0, 0]\nheight = 2.0\nsize = [64, 64]\n"
GRID = "".join(f"{x / 10} {y / 10} 0\n" for x in range(-10, 11) for y in range(-10, 11))


def sphere_points(count=2000):
    """Return points spread evenly over the unit sphere."""
    at = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * at / count), np.pi * (1.0 + 5.0**0.5) * at
    return np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=-1)


def write(folder, name, text):
    """Write a text file and return its path."""
    path = folder / name
    path.write_text(text)
    return path


def scene_of(folder, keys, light=""):
    """Return a scene of one object that has these keys."""
    return wf.load_scene(write(folder, "scene.toml", CAMERA + light + "[[object]]\n" + keys))


@pytest.mark.parametrize(
    ("name", "text", "normal", "color"),
    [
        ("a.xyz", "1 2 3\n4 5 6\n", None, None),
        ("a.pts", "2\n1 2 3\n4 5 6\n", None, None),
        ("a.xyz", "// a comment\n# another\n1, 2, 3\n4, 5, 6\n", None, None),
        ("a.xyz", "1 2 3 0 1 0\n4 5 6 0 0.8 0.6\n", (0, 1, 0), None),
        ("a.xyz", "1 2 3 128 0 255\n4 5 6 0 0 0\n", None, (HALF, 0, 1)),
        ("a.pwn", "2\n1 2 3 0 5 0\n4 5 6 0 8 6\n", (0, 1, 0), None),
        ("a.pts", "2\n1 2 3 -17 128 0 255\n4 5 6 99 0 0 0\n", None, (HALF, 0, 1)),
        ("a.pts", "2\n1 2 3 -17\n4 5 6 99\n", None, None),
        ("a.xyz", "1 2 3 0 1 0 128 0 255\n4 5 6 0 1 0 0 0 0\n", (0, 1, 0), (HALF, 0, 1)),
        ("a.xyz", "1 2 3 128 0 255 0 1 0\n4 5 6 0 0 0 0 1 0\n", (0, 1, 0), (HALF, 0, 1)),
        ("a.xyz", "1 2 3 0.5019607843137255 0 1\n4 5 6 0 0 0\n", None, (HALF, 0, 1)),
    ],
)
def test_text_files(tmp_path, name, text, normal, color):
    """Columns are positions, an intensity that is left aside, normals of unit length, colours in sRGB."""
    points = load_points(write(tmp_path, name, text))
    np.testing.assert_array_equal(points.points, [[1, 2, 3], [4, 5, 6]])
    for found, expected in ((points.normals, normal), (points.color, color)):
        assert (found is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(found[0], expected, atol=1e-7)


@pytest.mark.parametrize("binary", [False, True])
def test_ply_files(tmp_path, binary):
    """A ply gives positions, normals, colours and alpha, in either encoding."""
    kinds = [(c, "<f4") for c in ("x", "y", "z", "nx", "ny", "nz")]
    kinds += [(c, "u1") for c in ("red", "green", "blue", "alpha")]
    rows = np.array([(1, 2, 3, 0, 2, 0, 128, 0, 255, 51), (4, 5, 6, 0, 0, 1, 0, 0, 0, 255)], dtype=kinds)
    properties = "".join(f"property {'float' if t == '<f4' else 'uchar'} {c}\n" for c, t in kinds)
    form = "binary_little_endian" if binary else "ascii"
    head = f"ply\nformat {form} 1.0\nelement vertex 2\n{properties}end_header\n".encode()
    text = "".join(" ".join(str(value) for value in row) + "\n" for row in rows.tolist())
    path = tmp_path / "a.ply"
    path.write_bytes(head + (rows.tobytes() if binary else text.encode()))
    points = load_points(path)
    np.testing.assert_array_equal(points.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(points.normals, [[0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(points.color, [[HALF, 0, 1], [0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(points.opacity, [0.2, 1.0])


def test_spacing_is_the_mean_distance_to_the_nearest_other_point():
    """Nearest distances 1, 1, 2 of points on a line; a point given twice counts once."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 0, 0]])
    assert spacing(points) == pytest.approx(4.0 / 3.0)


def test_estimated_normals_of_a_sphere_face_outwards():
    """On 2000 points of a sphere they are within 2 degrees of the truth, all on the same side."""
    points = sphere_points()
    assert np.einsum("ij,ij->i", estimate_normals(points), points).min() > np.cos(np.radians(2.0))


def test_each_part_of_a_set_has_its_own_outside():
    """Two far spheres: neighbours connect neither with the other, both face outwards."""
    points = sphere_points(500)
    normals = estimate_normals(np.concatenate([points, points + np.array([10.0, 0, 0])]))
    assert np.einsum("ij,ij->i", normals, np.concatenate([points, points])).min() > 0.9


def test_normals_of_repeated_points_and_tiny_sets():
    """A point given twice has one normal; two points have normals across their line."""
    points = sphere_points(300)
    normals = estimate_normals(np.concatenate([points, points[:5]]))
    np.testing.assert_array_equal(normals[:5], normals[-5:])
    two = estimate_normals(np.array([[0.0, 0, 0], [1, 0, 0]]))
    np.testing.assert_allclose(two[:, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-0.6, 0.0, -0.8)])
def test_a_disc_stands_around_its_point(normal):
    """Corners lie in the plane of the point, at the radius, counterclockwise about the normal."""
    points = np.array([[0.0, 0, 0], [2, 1, 2]])
    mesh = surfels(PointSet(points, np.array([normal, normal], dtype=float)), radius=0.5, segments=6)
    assert mesh.vertices.shape == (12, 3)
    assert mesh.faces.shape == (8, 3)
    offset = mesh.vertices - np.repeat(points, 6, axis=0)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 1.5)
    np.testing.assert_allclose(offset @ np.array(normal), 0.0, atol=1e-12)
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (area @ np.array(normal) > 0).all()
    # A regular hexagon of radius 1.5 each.
    assert np.linalg.norm(area, axis=1).sum() / 2 == pytest.approx(2 * 1.5**3 * 3**0.5)


def test_a_scene_of_points(tmp_path):
    """Points become an object of discs, 10P thick, with the colours of their file; keys of an object apply."""
    write(tmp_path, "set.xyz", "0 0 0 0 0 1 128 0 255\n0.5 0 0 0 0 1 0 0 0\n")
    (item,) = scene_of(tmp_path, 'points = "set.xyz"\nopacity = 0.5\ntranslate = [0, 0, 1]\n').objects
    assert (item.name, item.opacity, item.thickness, item.thickness_unit) == ("set", 0.5, 10.0, "P")
    assert item.vertices.shape == (16, 3)
    np.testing.assert_allclose(item.color[:8], [[HALF, 0, 1]] * 8, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(item.vertices[:8], axis=1), 1.0, rtol=1e-6)
    assert item.matrix[2, 3] == 1
    keys = 'points = "set.xyz"\nname = "ball"\nradius = 0.4\nsegments = 5\ncolor = [1, 0, 0]\nthickness = 0.1\n'
    (item,) = scene_of(tmp_path, keys).objects
    assert (item.name, item.thickness, item.thickness_unit) == ("ball", 0.1, "scene")
    np.testing.assert_allclose(np.linalg.norm(item.vertices[:5], axis=1), 0.2, rtol=1e-6)
    np.testing.assert_allclose(item.color, [1, 0, 0])


def test_surfels_cover_their_surface_in_layers(tmp_path):
    """A grid of points in a plane is captured without holes, several discs deep, at the depth of the plane."""
    write(tmp_path, "grid.xyz", GRID)
    scene = scene_of(tmp_path, 'points = "grid.xyz"\nradius = 1.5\n')
    fragments = wf.capture(scene)
    counts = np.diff(fragments.offsets)
    # Discs of 1.5 spacings cover π·1.5² = 7.07 times the plane; octagons 6.36 times.
    assert counts.min() >= 3
    assert counts.mean() == pytest.approx(8 * np.sin(np.pi / 4) / 2 * 1.5**2, rel=0.05)
    np.testing.assert_allclose(fragments.depth, 3.0, rtol=1e-6)


def test_light_falls_on_points(tmp_path):
    """The normals of points are lit: estimated ones of a plane, from either side."""
    write(tmp_path, "grid.xyz", GRID)
    light = "[light]\ndirection = [0, 0.6, 0.8]\nambient = 0.2\n"
    scene = scene_of(tmp_path, 'points = "grid.xyz"\n', light)
    (item,) = scene.objects
    np.testing.assert_allclose(assemble(scene).rgba[:, 0] / item.color[0], 0.2 + 0.8 * 0.8, rtol=1e-5)


def test_gradients_reach_the_colours_of_discs(tmp_path):
    """An image of surfels is differentiable like any other: more red for all of them, more red in the image."""
    torch = pytest.importorskip("torch")
    write(tmp_path, "grid.xyz", GRID)
    scene = scene_of(tmp_path, 'points = "grid.xyz"\nopacity = 0.5\n')
    color = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
    wf.render(scene, parameters={"grid.color": color})[..., 0].sum().backward()
    covered = float(wf.render(scene)[..., 3].sum())
    np.testing.assert_allclose(color.grad.numpy(), [covered, 0.0, 0.0], rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "1 2 3\n", "unknown kind, expected one of .ply, .pts, .pwn, .xyz"),
        ("a.xyz", "", "got no points in"),
        ("a.xyz", "1 2 3 4 5\n", "5 columns, expected 3, 4, 6, 7 or 9"),
        ("a.xyz", "1 2 three\n", "cannot be read: .*three"),
        ("a.xyz", "1 2 nan\n", "a position is not finite"),
        ("a.xyz", "1 2 3 300 0 0\n", "a colour is out of its range"),
        ("a.xyz", "1 2 3\n1 2 3\n", "got 1 distinct points, expected at least 2"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "got no points"),
        ("a.ply", "no ply", "cannot be read"),
    ],
)
def test_refused_files(tmp_path, name, text, words):
    """What cannot be used is named in one line, with the scene file and the key."""
    write(tmp_path, name, text)
    with pytest.raises(wf.SceneError, match=rf"scene.toml: object\[0\].points: .*{words}") as caught:
        scene_of(tmp_path, f'points = "{name}"\n')
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('points = "b.xyz"\n', "points: got no such file at"),
        ('points = "../b.xyz"\n', 'points: got "../b.xyz", outside of'),
        ('points = "a.xyz"\nradius = 0\n', "radius: got 0, expected a number above 0"),
        ('points = "a.xyz"\nsegments = 2\n', "segments: got 2, expected a whole number from 3 to 64"),
        ('points = "a.xyz"\nnormals = "flat"\n', "normals: got an unknown key of points"),
        ('points = "a.xyz"\nprimitive = "cube"\n', "got both primitive and points, expected mesh, primitive or"),
    ],
)
def test_refused_keys(tmp_path, keys, words):
    """Keys of points are checked as all others are."""
    write(tmp_path, "a.xyz", "0 0 0\n1 0 0\n")
    with pytest.raises(wf.SceneError, match=words):
        scene_of(tmp_path, keys)


def test_scipy_is_named_where_it_is_missing(tmp_path, monkeypatch):
    """Without scipy the error says what needs it and how to get it."""

    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    write(tmp_path, "a.xyz", "0 0 0\n1 0 0\n")
    monkeypatch.setattr("importlib.import_module", missing)
    with pytest.raises(ImportError, match=r"scene.toml: object\[0\].points: .*scipy.*pip install 'warpfrag\[fit\]'"):
        scene_of(tmp_path, 'points = "a.xyz"\n')
