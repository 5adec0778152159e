"""Boolean expressions of closed objects along the rays of pixels: boxes by hand, where faces coincide, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from capture_scenes import orthographic, perspective, scene, surface

import warpfrag as wf
from warpfrag.shapes.primitives import cube, sphere

EXPRESSIONS = ["a | b", "a & b", "a - b", "b - a", "a ^ b", "(a | b) - (a & b)", "a - (b | c)", "(a & b) | c"]


def box(name: str, near: float, far: float, half: float = 5.0, **look):
    """Return a box along the line of sight, between two depths."""
    mesh = cube((2 * half, 2 * half, far - near))
    middle = np.array([0.0, 0.0, 0.5 * (near + far)])
    return surface(mesh.vertices + middle, mesh.faces, name, **look)


def depths(found) -> list[float]:
    """Return the depths of the middle pixel's fragments."""
    return found[(2, 2)].depth.tolist()


def line(*boxes, expression: str, **options):
    """Return the surfaces of an expression of boxes (name, near, far) along one ray, with sides and without."""
    setting = scene(orthographic((5, 5), 1.0), *(box(*each) for each in boxes))
    fragments = wf.capture(setting)
    sided = wf.csg(fragments, expression, scene=setting, **options)
    turns = wf.csg(fragments, expression, names=[item.name for item in setting.objects], **options)
    assert sided.count == turns.count
    assert depths(sided) == depths(turns)
    return depths(sided)


def test_boxes_that_overlap():
    """Entries and exits of two intervals by hand."""
    boxes = (("a", 1, 3), ("b", 2, 4))
    expected = {"a | b": [1, 4], "a & b": [2, 3], "a - b": [1, 2], "b - a": [3, 4], "a ^ b": [1, 2, 3, 4]}
    for expression, surfaces in expected.items():
        # x ^ y ends and begins at one depth only where both change.
        assert line(*boxes, expression=expression) == surfaces


def test_faces_that_coincide():
    """All fragments of one depth are one event: no skin, no wall, no doubled surface."""
    assert line(("a", 1, 3), ("b", 1, 2), expression="a - b") == [2, 3]
    assert line(("a", 1, 3), ("b", 1, 2), expression="a | b") == [1, 3]
    assert line(("a", 1, 3), ("b", 1, 2), expression="a & b") == [1, 2]
    assert line(("a", 1, 2), ("b", 2, 3), expression="a | b") == [1, 3]
    assert line(("a", 1, 2), ("b", 2, 3), expression="a & b") == []
    assert line(("a", 1, 2), ("b", 2, 3), expression="a - b") == [1, 2]
    assert line(("a", 1, 3), ("b", 1, 3), expression="a - b") == []
    assert line(("a", 1, 3), ("b", 1, 3), expression="a ^ b") == []


def test_tolerance_joins_events():
    """Faces that nearly coincide leave a skin, unless they are within the tolerance."""
    boxes = (("a", 1, 3), ("b", 1.0625, 2))
    assert line(*boxes, expression="a - b") == [1, 1.0625, 2, 3]
    assert line(*boxes, expression="a - b", tolerance=0.1) == [2, 3]


def test_first_object_of_the_expression_gives_the_surface():
    """Of fragments that share a depth."""
    setting = scene(orthographic((5, 5), 1.0), box("a", 1, 3), box("b", 1, 3))
    fragments = wf.capture(setting)
    assert set(wf.csg(fragments, "a | b", scene=setting).object_id) == {0}
    assert set(wf.csg(fragments, "b | a", scene=setting).object_id) == {1}


def test_eye_inside():
    """A ray that leaves an object without having entered it has begun inside."""
    setting = scene(orthographic((5, 5), 1.0), box("a", -1, 3), box("b", 2, 4))
    fragments = wf.capture(setting)
    for options in ({"scene": setting}, {"names": ["a", "b"]}):
        assert depths(wf.csg(fragments, "a - b", **options)) == [2]
        assert depths(wf.csg(fragments, "a & b", **options)) == [2, 3]


def test_object_that_overlaps_itself():
    """With the scene, what is entered twice is left at the second exit."""
    parts = [box("a", 1, 3), box("a", 2, 4)]
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([parts[0].faces, parts[1].faces + len(parts[0].vertices)])
    setting = scene(orthographic((5, 5), 1.0), surface(vertices, faces, "a"), box("b", 2.5, 5))
    fragments = wf.capture(setting)
    assert depths(wf.csg(fragments, "a", scene=setting)) == [1, 4]
    assert depths(wf.csg(fragments, "a - b", scene=setting)) == [1, 2.5]


@pytest.mark.parametrize("turned", [False, True], ids=["outwards", "inwards"])
@pytest.mark.parametrize("mirrored", [False, True], ids=["plain", "mirrored"])
def test_winding_of_the_mesh_does_not_matter(turned, mirrored):
    """Sides are those of a closed mesh, whichever way round its triangles are, and wherever a matrix mirrors it."""
    mesh = sphere(0.8, 16)
    faces = mesh.faces[:, ::-1] if turned else mesh.faces
    matrix = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    matrix[2, 3] = 3.0
    ball = surface(mesh.vertices, faces, "ball", matrix=matrix)
    for camera in (perspective((15, 15)), orthographic((15, 15), 2.0)):
        setting = scene(camera, ball, box("box", 3, 4))
        fragments = wf.capture(setting)
        expected = wf.csg(fragments, "ball - box", names=["ball", "box"])
        found = wf.csg(fragments, "ball - box", scene=setting)
        np.testing.assert_array_equal(found.depth, expected.depth)
        np.testing.assert_array_equal(found.offsets, expected.offsets)
        np.testing.assert_array_equal(found.object_id, expected.object_id)
        assert found.count > 50


@pytest.mark.parametrize("expression", EXPRESSIONS)
@pytest.mark.parametrize("seed", range(3))
def test_random_intervals_against_a_plain_loop(expression, seed):
    """Boxes whose faces often coincide: the loop tries each depth's two sides."""
    random = np.random.default_rng(seed)
    ends = [tuple(np.sort(random.choice(np.arange(1, 7), 2, replace=False))) for _ in "abc"]
    boxes = [(name, *map(float, own)) for name, own in zip("abc", ends, strict=True)]

    def holds(z: float) -> bool:
        values = {name: near < z < far for name, near, far in boxes}
        return bool(eval(expression.replace(" - ", " & ~"), {}, {n: np.bool_(v) for n, v in values.items()}))

    marks = sorted({z for _, near, far in boxes for z in (near, far)})
    expected = [z for z in marks if holds(z - 0.5) != holds(z + 0.5)]
    assert line(*boxes, expression=expression) == expected


def test_many_pixels_at_once():
    """Each pixel by itself, pixels without fragments among them."""
    mesh = sphere(0.8, 16)
    balls = [
        surface(mesh.vertices + np.array([x, 0.0, 3.0]), mesh.faces, name) for x, name in ((-0.4, "a"), (0.4, "b"))
    ]
    setting = scene(perspective((21, 17)), *balls)
    fragments = wf.capture(setting)
    found = wf.csg(fragments, "a - b", scene=setting)
    assert found.shape == fragments.shape
    for row in range(17):
        for column in range(21):
            own = wf.csg(fragments[(row, column)], "a - b", names=["a", "b"])
            np.testing.assert_array_equal(found[(row, column)].depth, own.depth)


def test_gradients_go_through():
    """The surface's fragments are those of the capture, by indexing: torch in, torch out."""
    setting = scene(orthographic((5, 5), 1.0), box("a", 1, 3, opacity=0.5), box("b", 2, 4))
    opacity = torch.tensor(0.5, requires_grad=True)
    fragments = wf.capture(setting, parameters={"a.opacity": opacity})
    found = wf.csg(fragments, "a - b", scene=setting)
    assert isinstance(found.rgba, torch.Tensor)
    found.rgba[:, 3].sum().backward()
    # One of the two surfaces in each of 25 pixels is that of b.
    assert opacity.grad.item() == 25.0
    assert found.offsets.dtype == fragments.offsets.dtype
    assert wf.composite(found).shape == (5, 5, 4)


def test_names_in_quotes_and_by_id():
    """Names that are no identifiers, and ids that are not in order."""
    setting = scene(orthographic((5, 5), 1.0), box("the block", 1, 3), box("b-2", 2, 4))
    fragments = wf.capture(setting)
    assert depths(wf.csg(fragments, "'the block' - \"b-2\"", scene=setting)) == [1, 2]
    assert depths(wf.csg(fragments, "x - y", names={"y": 0, "x": 1})) == [3, 4]


def test_nothing_in_nothing_out():
    """No fragments, no surface."""
    empty = replace(wf.Fragments.from_lists([[]], (1, 1)), object_id=np.zeros(0, np.int32))
    found = wf.csg(empty, "a | b", names=["a", "b"])
    assert found.count == 0
    assert found.offsets.tolist() == [0, 0]


def test_bad_arguments():
    """Named, with what was got and what is expected."""
    setting = scene(orthographic((5, 5), 1.0), box("block", 1, 3))
    fragments = wf.capture(setting)

    def refuse(error, message, expression="block", given=fragments, **options):
        with pytest.raises(error, match=message):
            wf.csg(given, expression, **options)

    refuse(TypeError, "names: got none, expected the names of the objects, or the scene")
    refuse(TypeError, 'names: got "block", expected a list of names', names="block")
    refuse(ValueError, r'expression: got "blok", expected the name of an object \(did you mean "block"\?\)', "blok",
           scene=setting)  # fmt: skip
    for bad in ("block -", "block + block", "f(block)", "3", "", "-block"):
        refuse(ValueError, "expression: got .*, expected names of objects joined by", bad, scene=setting)
    refuse(TypeError, "expression: got int, expected a text", 3, scene=setting)
    refuse(ValueError, "tolerance: got -1", tolerance=-1, scene=setting)
    refuse(TypeError, "fragments: got int, expected Fragments", given=3, scene=setting)
    in_warp = wf.Fragments(*map(wp.array, (np.zeros((0, 4)), np.zeros(0), np.zeros(0), np.zeros(2, np.int32))), (1, 1))
    refuse(
        TypeError, "fragments: got Warp arrays, expected torch tensors or NumPy arrays", given=in_warp, scene=setting
    )
    refuse(TypeError, "scene: got int, expected a Scene", scene=3, names=["block"])
    refuse(ValueError, "fragments: got none of object_id", given=replace(fragments, object_id=None), scene=setting)
    refuse(
        ValueError, "fragments: got none of primitive_id", given=replace(fragments, primitive_id=None), scene=setting
    )
