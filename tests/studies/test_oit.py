"""The transparency study: its generated shapes are what they claim to be, and its functions run, figures included."""

import json

import numpy as np
import pytest
from study_modules import EXPERIMENTS, study_modules

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")

FOLDER = EXPERIMENTS / "oit"
MODULES = ("figures", "methods", "shapes", "study", "study_scenes", "tables")


@pytest.fixture(scope="module")
def oit():
    """The study's modules."""
    with study_modules(FOLDER, MODULES) as modules:
        yield modules


@pytest.fixture(scope="module")
def tiny(oit):
    """Settings that take the study seconds."""
    return oit.study.Settings(size=12, detail=0.002, repetitions=1)


def volume(mesh):
    """Return the signed volume inside a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def area(mesh):
    """Return the area of a mesh's triangles."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def test_hair_stays_in_its_ball(oit):
    """Strips of two triangles a segment grow from the core to the unit sphere."""
    mesh = oit.shapes.hair_ball(200, 14, width=0.001)
    assert mesh.faces.shape == (200 * 14 * 2, 3)
    assert mesh.vertices.shape == mesh.normals.shape == mesh.color.shape == (200 * 15 * 2, 3)
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert distance.max() < 1.001
    assert 0.01 < distance.min() < 0.2


def test_prisms_are_closed_and_face_outwards(oit):
    """The volume of a square prism and of one with a hole, and of a gear between its circles."""
    square = oit.shapes.circle(2.0**0.5, 4)
    assert volume(oit.shapes.prism(square, 3.0)) == pytest.approx(12.0)
    assert volume(oit.shapes.prism(square, 3.0, 0.5 * square)) == pytest.approx(9.0)
    # Teeth of a tenth of the radius to both sides of it, as wide as the gaps but for their slope.
    assert volume(oit.shapes.gear(15, 1.0, 1.0, 0.5)) == pytest.approx(np.pi * 0.75, rel=0.05)


def test_pipes_keep_their_radius(oit):
    """Both walls of a bent pipe are at their distance from the path."""
    path = oit.shapes.rounded([[0, 0, 0], [1, 0, 0], [1, 1, 0]], 0.3)
    mesh = oit.shapes.pipe(path, 0.1, wall=0.5, segments=8)
    half = len(mesh.vertices) // 2
    offset = mesh.vertices.reshape(2, len(path), 8, 3) - path[:, None]
    np.testing.assert_allclose(np.linalg.norm(offset[0], axis=-1), 0.1)
    np.testing.assert_allclose(np.linalg.norm(offset[1], axis=-1), 0.05)
    assert half == len(path) * 8


def test_the_machine_has_hundreds_of_parts(oit):
    """Every part has a name of its own and triangles."""
    parts = list(oit.shapes.machine())
    assert len({name for name, _, _ in parts}) == len(parts) > 400
    assert all(len(mesh.faces) > 0 and np.isfinite(mesh.vertices).all() for _, mesh, _ in parts)


def test_text_has_the_area_of_its_outlines(oit):
    """An H of three bars and an O with its hole: trapezoids cover what the font's polygons enclose, once."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    path = TextPath((0, 0), "HO", size=1.0, prop=FontProperties(weight="bold"))
    enclosed = 0.0
    for polygon in path.to_polygons():
        x, y = np.asarray(polygon).T
        enclosed += 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    capital = TextPath((0, 0), "H", size=1.0, prop=FontProperties(weight="bold")).get_extents().height
    mesh = oit.shapes.text("HO", 0.5)
    assert area(mesh) == pytest.approx(abs(enclosed) * (0.5 / capital) ** 2, rel=1e-6)
    assert mesh.vertices[:, 0].min() == pytest.approx(-mesh.vertices[:, 0].max())


def test_points_are_scattered_evenly_over_a_mesh(oit):
    """Half of the area gets half of the points; they lie on the faces, with their normals."""
    from warpfrag.shapes.primitives import grid

    points = oit.shapes.sample_points(grid((2.0, 1.0), (3, 5)), 4000)
    np.testing.assert_allclose(points.points[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(points.normals, np.tile([0.0, 0.0, 1.0], (4000, 1)), atol=1e-12)
    # 0.5 with a standard deviation of 0.008.
    assert np.mean(points.points[:, 0] < 0.0) == pytest.approx(0.5, abs=0.03)


def test_errors_count_covered_pixels_only(oit):
    """Levels by hand: differences of 3 and 6 in one of the channels of two pixels, a third is not covered."""
    image, other = np.zeros((1, 3, 3), np.float32), np.zeros((1, 3, 3), np.float32)
    image[0, 0, 0], image[0, 1, 1], image[0, 2] = 3.0, 6.0, 100.0
    found = oit.methods.errors(image, other, np.array([[True, True, False]]))
    assert (found["mean"], found["max"]) == (pytest.approx(1.5), pytest.approx(2.0))
    assert found["rmse"] == pytest.approx((45.0 / 6.0) ** 0.5)


def test_sorting_a_capture_keeps_its_pixels(oit, tiny):
    """The sorted copy has the same fragments in each pixel, by depth; both composite to the same image."""
    import warpfrag as wf

    capture = oit.methods.capture(oit.study_scenes.engine(tiny.size, 0.1))
    for begin, end in zip(capture.stream.offsets[:-1], capture.stream.offsets[1:], strict=True):
        np.testing.assert_array_equal(capture.fragments.depth[begin:end], np.sort(capture.stream.depth[begin:end]))
    np.testing.assert_array_equal(*(wf.composite(part, merge="none") for part in capture))


def test_the_study_runs_and_is_drawn(oit, tiny, tmp_path, capsys):
    """All figures at a tiny size: data, pictures, tables; SFM and exact merging are nearer to the A-buffer than SKB."""
    oit.study.run(tiny, tmp_path)
    numbers = json.loads((tmp_path / "fig10.json").read_text())["numbers"]
    assert list(numbers) == ["engine", "hair ball", "floor"]
    errors = {way: error["mean"] for way, error in numbers["hair ball"]["errors"].items()}
    assert max(errors["DFB+SFM"], errors["exact"]) < errors["SKB+OFM"] <= errors["SKB"]
    documents = oit.figures.draw(tmp_path, tmp_path / "figures")
    assert set(documents) == {*oit.study.FIGURES, "10b"}
    assert sorted(path.stem for path in (tmp_path / "figures").iterdir()) == sorted(f"fig{name}" for name in documents)
    report = oit.tables.report(documents)
    for heading in ("the paper claims | measured", "scene | objects", "mean / RMS / 99th", "count + store + resolve"):
        assert f"\n| {heading}" in f"\n{report}"
    capsys.readouterr()


def test_slabs_fill_up_as_eq_4_says(oit, tiny):
    """Fig. 8 is drawn from the package; the curves are those of the formula."""
    arrays, _ = oit.study.figure_8(tiny)
    r = np.linspace(0.0, 1.0, 201)
    for name, found in arrays.items():
        opacity, beta = (float(part) for part in name.split())
        expected = beta * r * opacity + (1.0 - beta) * (1.0 - (1.0 - opacity) ** r)
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_model_takes_the_place_of_the_generated_scenes(oit, tmp_path):
    """A mesh file and a point file are scaled into view, whatever their size and place."""
    (tmp_path / "roof.obj").write_text("v 10 0 0\nv 50 0 0\nv 10 40 0\nv 50 40 30\nf 1 2 3\nf 3 2 4\n")
    (tmp_path / "dots.xyz").write_text("".join(f"{x} {y} 7\n" for x in range(5) for y in range(5)))
    settings = oit.study.Settings(16, models=(tmp_path / "roof.obj", tmp_path / "dots.xyz"))
    for name, scene in settings.complex_scenes():
        assert scene.objects[0].name == name
        assert oit.methods.layer_counts(oit.methods.capture(scene).fragments)["fragments"] > 20


def test_tables_go_between_their_markers(oit, tmp_path):
    """What stands around the markers stays; without them the file is refused."""
    path = tmp_path / "README.md"
    path.write_text(f"above\n{oit.tables.BEGIN}\nold\n{oit.tables.END}\nbelow\n")
    oit.tables.insert(path, "new\n")
    assert path.read_text() == f"above\n{oit.tables.BEGIN}\n\nnew\n\n{oit.tables.END}\nbelow\n"
    path.write_text("nothing")
    with pytest.raises(ValueError, match="found no markers"):
        oit.tables.insert(path, "new\n")


def test_the_readme_has_the_markers(oit):
    """The figures script can write its tables."""
    text = (FOLDER / "README.md").read_text()
    assert text.index(oit.tables.BEGIN) < text.index(oit.tables.END)
