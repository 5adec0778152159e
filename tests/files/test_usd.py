"""USD stages: primvars, materials, instancers, orientation, holes, times; and the process that reads them."""

import numpy as np
import pytest

from warpfrag.files import usd
from warpfrag.files.meshes import load_mesh, load_parts

pytest.importorskip("pxr", reason="usd-core is not installed")

TRIANGLE = """
int[] faceVertexCounts = [3]
int[] faceVertexIndices = [0, 1, 2]
point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
uniform token subdivisionScheme = "none"
"""
TWO = """
int[] faceVertexCounts = [3, 3]
int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
uniform token subdivisionScheme = "none"
"""
GREEDY = """import resource, sys
most = int(sys.argv[4])
resource.setrlimit(resource.RLIMIT_AS, (most, most))
bytearray(2**33)
"""
BOUND = '(\nprepend apiSchemas = ["MaterialBindingAPI"]\n)'


def material(name, inputs):
    """Return a material of a preview surface with these inputs."""
    return f"""def Material "{name}" {{
token outputs:surface.connect = </{name}/s.outputs:surface>
def Shader "s" {{
uniform token info:id = "UsdPreviewSurface"
{inputs}
token outputs:surface
}}
}}
"""


def stage(folder, text, head=""):
    """Write a stage and return its path."""
    path = folder / "a.usda"
    path.write_text(f"#usda 1.0\n{head}{text}")
    return path


def test_primvars_are_inherited(tmp_path):
    """A constant colour of a parent is that of its meshes, their own comes first."""
    color = 'color3f[] primvars:displayColor = [(0.1, 0.2, 0.3)] (interpolation = "constant")\n'
    color += 'float[] primvars:displayOpacity = [0.4] (interpolation = "constant")\n'
    own = "color3f[] primvars:displayColor = [(1, 0, 0)]\n"
    text = f'def Xform "x" {{\n{color}def Mesh "a" {{\n{TRIANGLE}}}\ndef Mesh "b" {{\n{TRIANGLE}{own}}}\n}}\n'
    first, second = load_parts(stage(tmp_path, text))
    np.testing.assert_allclose(first.color, [0.1, 0.2, 0.3], rtol=1e-6)
    assert first.opacity == pytest.approx(0.4)
    np.testing.assert_array_equal(second.color, [1, 0, 0])
    assert (first.name, second.name) == ("a", "b")


def test_a_bound_material_comes_before_display_color(tmp_path):
    """Its constants count, its defaults too; an opacity below the threshold is none."""
    look = material("G", "color3f inputs:diffuseColor = (0, 1, 0)\nfloat inputs:opacity = 0.25")
    mesh = f'def Mesh "m" {BOUND} {{\n{TRIANGLE}rel material:binding = </G>\n'
    mesh += "color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]\n}\n"
    found = load_mesh(stage(tmp_path, look + mesh))
    np.testing.assert_array_equal(found.color, [0, 1, 0])
    assert found.opacity == 0.25
    found = load_mesh(stage(tmp_path, material("G", "float inputs:opacity = 0.25") + mesh))
    np.testing.assert_allclose(found.color, [0.18] * 3, rtol=1e-6)
    masked = material("G", "float inputs:opacity = 0.25\nfloat inputs:opacityThreshold = 0.5")
    assert load_mesh(stage(tmp_path, masked + mesh)).opacity == 0.0


def test_subsets_of_faces_have_their_materials(tmp_path):
    """Faces of a GeomSubset have its material, the others what the mesh has."""
    look = material("R", "color3f inputs:diffuseColor = (1, 0, 0)")
    subset = (
        f'def GeomSubset "s" {BOUND} {{\nuniform token elementType = "face"\n'
        'uniform token familyName = "materialBind"\n'
        "int[] indices = [1]\nrel material:binding = </R>\n}\n"
    )
    mesh = f'def Mesh "m" {{\n{TWO}color3f[] primvars:displayColor = [(0, 0, 1)]\n{subset}}}\n'
    found = load_mesh(stage(tmp_path, look + mesh))
    np.testing.assert_array_equal(found.color[found.faces[:, 0]], [[0, 0, 1], [1, 0, 0]])
    assert len(found.vertices) == 6


def test_instancers_draw_their_prototypes(tmp_path):
    """A prototype is drawn at each instance that is not hidden, and not where it is defined."""
    text = f"""def PointInstancer "p" {{
rel prototypes = </p/proto>
int[] protoIndices = [0, 0, 0]
point3f[] positions = [(10, 0, 0), (20, 0, 0), (30, 0, 0)]
int64[] ids = [1, 2, 3]
int64[] invisibleIds = [2]
double3 xformOp:translate = (0, 100, 0)
uniform token[] xformOpOrder = ["xformOp:translate"]
def Xform "proto" {{
float3 xformOp:scale = (2, 2, 2)
uniform token[] xformOpOrder = ["xformOp:scale"]
def Mesh "m" {{
{TRIANGLE}
}}
}}
}}
"""
    found = load_mesh(stage(tmp_path, text))
    np.testing.assert_allclose(
        found.vertices, [[10, 100, 0], [12, 100, 0], [10, 102, 0], [30, 100, 0], [32, 100, 0], [30, 102, 0]], atol=1e-9
    )


def test_orientation_and_holes(tmp_path):
    """Left-handed faces and mirrored transforms keep their outside; faces named as holes are left out."""
    for extra, sign in (("", 1), ('uniform token orientation = "leftHanded"\n', -1)):
        mesh = load_mesh(stage(tmp_path, f'def Mesh "m" {{\n{TRIANGLE}{extra}}}\n'))
        a, b, c = mesh.vertices[mesh.faces[0]]
        assert np.sign(np.cross(b - a, c - a)[2]) == sign
    mirror = 'float3 xformOp:scale = (-1, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]\n'
    mesh = load_mesh(stage(tmp_path, f'def Mesh "m" {{\n{TRIANGLE}{mirror}}}\n'))
    a, b, c = mesh.vertices[mesh.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0
    mesh = load_mesh(stage(tmp_path, f'def Mesh "m" {{\n{TWO}int[] holeIndices = [0]\n}}\n'))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces[0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]])


def test_one_time_for_all(tmp_path):
    """Everything is taken at the start of the stage, or else at the earliest sample of all."""
    moving = "double3 xformOp:translate.timeSamples = { 5: (5, 0, 0), 10: (10, 0, 0) }\n"
    moving += 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    growing = TRIANGLE.replace(
        "points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]",
        "points.timeSamples = { 1: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 11: [(0, 0, 0), (11, 0, 0), (0, 1, 0)] }",
    )
    text = f'def Mesh "m" {{\n{growing}{moving}}}\n'
    np.testing.assert_allclose(load_mesh(stage(tmp_path, text)).vertices[1], [6, 0, 0])
    head = "(\nstartTimeCode = 10\nendTimeCode = 20\n)\n"
    np.testing.assert_allclose(load_mesh(stage(tmp_path, text, head)).vertices[1], [20, 0, 0])


def test_what_is_left_out_is_named(tmp_path):
    """Subdivision, other shapes and images, in one warning."""
    image = "color3f inputs:diffuseColor.connect = </G/t.outputs:rgb>"
    look = material("G", image)[:-2] + 'def Shader "t" {\nuniform token info:id = "UsdUVTexture"\n'
    look += "color3f outputs:rgb\n}\n}\n"
    smooth = TRIANGLE.replace('"none"', '"catmullClark"')
    text = f'{look}def Mesh "m" {BOUND} {{\n{smooth}rel material:binding = </G>\n}}\ndef Sphere "s" {{\n}}\n'
    words = (
        r"a.usda: subdivision \(catmullClark\) is not supported, drawn as the control mesh; texture: diffuseColor of "
        r"material G \(UsdUVTexture\) is not supported, drawn without; Sphere is not drawn$"
    )
    with pytest.warns(UserWarning, match=words):
        load_mesh(stage(tmp_path, text))


def test_parsing_errors_have_line_and_column(tmp_path):
    """USD's own words about where the file is wrong are part of the message."""
    with pytest.raises(ValueError, match=r"got a USD file that cannot be read: .*a.usda \(.*a.usda:3:2"):
        load_mesh(stage(tmp_path, 'def Mesh "m" {\n int[] = = 3\n}\n'))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("import time\ntime.sleep(60)\n", "its reader took more than 1 s"),
        (GREEDY, "its reader needed more than 1 GiB of memory"),
        ("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n", "its reader was ended by SIGSEGV"),
        ("import sys\nsys.exit('no such thing')\n", "no such thing"),
    ],
)
def test_the_process_that_reads_has_limits(tmp_path, monkeypatch, script, words):
    """A reader that is slow, greedy or dies is one line, and takes nothing with it."""
    stand_in = tmp_path / "reader.py"
    stand_in.write_text(script)
    monkeypatch.setattr(usd, "SCRIPT", stand_in)
    monkeypatch.setattr(usd, "MOST_SECONDS", 1.0)
    monkeypatch.setattr(usd, "MOST_BYTES", 2**30)
    with pytest.raises(ValueError, match=rf"got a USD file that cannot be read: .*a.usda \({words}\)"):
        load_mesh(stage(tmp_path, ""))


def test_references_that_lead_nowhere_are_named(tmp_path):
    """A missing reference leaves the rest of the stage, with one warning."""
    text = f'def "gone" (references = @no.usda@)\n{{\n}}\ndef Mesh "m" {{\n{TRIANGLE}}}\n'
    with pytest.warns(UserWarning, match=r"a.usda: cannot find .*no.usda$"):
        assert len(load_mesh(stage(tmp_path, text)).faces) == 1
