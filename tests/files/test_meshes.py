"""Mesh files, each written here: geometry, colours in linear light, opacity, textures, and what is refused."""

import base64
import json
import sys

import numpy as np
import pytest
from PIL import Image

from warpfrag.files.meshes import load_mesh
from warpfrag.files.scene_file import load_scene

HALF = 0.21586050011389926  # 128/255 in sRGB, in linear light
POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
FACE = np.array([[0, 1, 2]], dtype=np.uint16)
QUAD_OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def write(folder, name, text):
    """Write a text file, its folder too, and return its path."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def image(folder, name, pixel):
    """Write an image of two equal pixels."""
    Image.fromarray(np.array([[pixel, pixel]], dtype=np.uint8)).save(folder / name)


def gltf(folder, materials, parts, images=(), name="scene.gltf"):
    """Write a glTF of one triangle a part: (material index, extra attributes by name, node as a mapping)."""
    views, accessors, meshes, nodes, data = [], [], [], [], b""

    def accessor(array, target_type):
        nonlocal data
        component = {"f": 5126, "H": 5123, "B": 5121}[array.dtype.char]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        normalized = {"normalized": True} if target_type == "VEC4" and component == 5121 else {}
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": array.size if target_type == "SCALAR" else len(array),
                "type": target_type,
                **normalized,
            }
        )
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
        return len(accessors) - 1

    for material, attributes, node in parts:
        places = {"POSITION": accessor(POSITIONS, "VEC3")}
        for key, array in attributes.items():
            places[key] = accessor(array, f"VEC{array.shape[1]}")
        primitive = {"attributes": places, "indices": accessor(FACE, "SCALAR")}
        if material is not None:
            primitive["material"] = material
        meshes.append({"primitives": [primitive]})
        nodes.append({"mesh": len(meshes) - 1, **node})
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "images": [{"uri": name} for name in images],
        "textures": [{"source": index} for index in range(len(images))],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"uri": uri, "byteLength": len(data)}],
    }
    return write(folder, name, json.dumps({key: value for key, value in document.items() if value}))


def material(alpha_mode=None, factor=None, texture=None, **more):
    """Return a glTF material."""
    surface = {} if factor is None else {"baseColorFactor": factor}
    if texture is not None:
        surface["baseColorTexture"] = {"index": texture}
    mode = {} if alpha_mode is None else {"alphaMode": alpha_mode}
    return {"pbrMetallicRoughness": surface, **mode, **more}


def test_ply_vertex_colors_are_srgb(tmp_path):
    """8-bit vertex colours become linear, alpha stays as it is; vertices keep their order, unused ones included."""
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha"))
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "9 9 9 0 0 0 255\n0 0 0 128 0 255 51\n1 0 0 128 0 255 51\n0 1 0 128 0 255 102\n3 1 3 2\n"
    mesh = load_mesh(write(tmp_path, "a.ply", header + rows))
    np.testing.assert_array_equal(mesh.vertices, [[9, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[1, 3, 2]])
    np.testing.assert_allclose(mesh.color[1], [HALF, 0, 1], rtol=1e-6)
    np.testing.assert_allclose(mesh.opacity, [1, 0.2, 0.2, 0.4])


def test_plain_obj_keeps_its_vertices(tmp_path):
    """Without materials an obj says nothing of colour, opacity or normals; a quad is two triangles."""
    mesh = load_mesh(write(tmp_path, "a.obj", QUAD_OBJ + "f 1 2 3 4\n"))
    assert (len(mesh.vertices), len(mesh.faces)) == (4, 2)
    assert (mesh.color, mesh.opacity, mesh.normals, mesh.textures) == (None, None, None, [])


def test_obj_materials(tmp_path):
    """Kd is sRGB, d and Tr are opacity, parts follow each other in one mesh with colours per vertex."""
    write(tmp_path, "a.mtl", f"newmtl red\nKd {128 / 255} 0 0\nd 0.25\n\nnewmtl white\nKd 1 1 1\nTr 0.25\n")
    text = "mtllib a.mtl\n" + QUAD_OBJ + "usemtl red\nf 1 2 3\nusemtl white\nf 1 3 4\n"
    mesh = load_mesh(write(tmp_path, "a.obj", text))
    np.testing.assert_allclose(mesh.color[mesh.faces[:, 0]], [[HALF, 0, 0], [1, 1, 1]], rtol=1e-6)
    np.testing.assert_allclose(mesh.opacity[mesh.faces[:, 0]], [0.25, 0.75])


def test_obj_texture(tmp_path):
    """map_Kd is kept with the file's texture coordinates, v up."""
    image(tmp_path, "wood.png", [255, 128, 0])
    write(tmp_path, "a.mtl", "newmtl wood\nKd 1 1 1\nmap_Kd wood.png\n")
    text = "mtllib a.mtl\n" + QUAD_OBJ + "vt 0 0\nvt 1 0\nvt 1 1\nusemtl wood\nf 1/1 2/2 3/3\n"
    mesh = load_mesh(write(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.uv, mesh.vertices[:, :2])
    np.testing.assert_allclose(mesh.textures[0][0, 0], [1, HALF, 0, 1], rtol=1e-6)


def test_missing_and_outside_files_of_a_mesh(tmp_path):
    """An image that is missing or lies outside of the root is left out with a warning; nothing outside is read."""
    image(tmp_path, "secret.png", [1, 2, 3])
    write(tmp_path / "in", "a.mtl", "newmtl a\nKd 1 1 1\nmap_Kd ../secret.png\nnewmtl b\nKd 1 0 0\nmap_Kd no.png\n")
    faces = "usemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 3/1 4/1\n"
    path = write(tmp_path / "in", "a.obj", "mtllib a.mtl\n" + QUAD_OBJ + "vt 0 0\n" + faces)
    with pytest.warns(UserWarning, match=r"cannot find no.png; does not read ../secret.png outside of"):
        assert load_mesh(path).textures == []
    with pytest.warns(UserWarning, match="cannot find no.png$"):
        assert len(load_mesh(path, root=tmp_path).textures) == 1


def test_stl_vertices_are_merged(tmp_path):
    """An stl repeats its vertices for each triangle: equal ones are one, in order of first use."""
    facet = "facet normal 0 0 1\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n"
    text = facet.format("0 0 0", "1 0 0", "0 1 0") + facet.format("1 0 0", "1 1 0", "0 1 0")
    mesh = load_mesh(write(tmp_path, "a.stl", f"solid a\n{text}endsolid a\n"))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [1, 3, 2]])


def test_gltf_scene_graph_and_alpha_modes(tmp_path):
    """Node transforms apply; factors are linear and exact; OPAQUE is 1, BLEND the alpha, MASK 0 or 1 by its cutoff."""
    materials = [
        material(None, [0.1, 0.2, 0.3, 0.4], name="a"),
        material("BLEND", [0.123456, 0.2, 0.3, 0.3], name="b"),
        material("MASK", [1, 1, 1, 0.3], name="c", alphaCutoff=0.25),
        material("MASK", [1, 1, 1, 0.3], name="d"),
    ]
    normals = {"NORMAL": np.tile(np.float32([0, 0, 1]), (3, 1))}
    parts = [(index, normals, {"translation": [index, 0, 0], "scale": [2, 2, 2]}) for index in range(4)]
    mesh = load_mesh(gltf(tmp_path, materials, parts))
    np.testing.assert_allclose(mesh.vertices, np.concatenate([2 * POSITIONS + [i, 0, 0] for i in range(4)]))
    np.testing.assert_array_equal(mesh.faces, np.arange(12).reshape(4, 3))
    np.testing.assert_allclose(mesh.opacity[::3], [1.0, 0.3, 1.0, 0.0])
    np.testing.assert_allclose(mesh.color[::3], [[0.1, 0.2, 0.3], [0.123456, 0.2, 0.3], [1, 1, 1], [1, 1, 1]])
    np.testing.assert_allclose(mesh.normals / np.linalg.norm(mesh.normals, axis=1)[:, None], [[0, 0, 1]] * 12)


def test_gltf_vertex_colors_are_linear(tmp_path):
    """COLOR_0 multiplies the factor; its bytes are linear."""
    colors = np.full((3, 4), 128, dtype=np.uint8)
    both = material("BLEND", [0.5, 1, 1, 0.5])
    mesh = load_mesh(gltf(tmp_path, [both], [(0, {"COLOR_0": colors}, {})]))
    np.testing.assert_allclose(mesh.color[0], np.array([0.5, 1, 1]) * 128 / 255)
    assert mesh.opacity == pytest.approx(0.5 * 128 / 255)
    mesh = load_mesh(gltf(tmp_path, [], [(None, {"COLOR_0": colors}, {})]))
    np.testing.assert_allclose(mesh.color, np.full((3, 3), 128 / 255))


def test_gltf_textures_of_several_parts(tmp_path):
    """Each face keeps its own image (shared ones once); parts without one have none; v points up."""
    image(tmp_path, "a.png", [255, 128, 0, 128])
    image(tmp_path, "b.png", [0, 0, 255, 128])
    materials = [
        material("BLEND", [1, 1, 1, 0.5], texture=0),
        material(None, texture=0),
        material("MASK", texture=1, alphaCutoff=0.6),
        material(None, [0.5, 0.5, 0.5, 1]),
    ]
    uv = {"TEXCOORD_0": np.float32([[0, 0], [1, 0], [0, 0.75]])}
    parts = [(place, uv, {}) for place in (0, 1, 2)] + [(3, {}, {}), (0, uv, {}), (None, {}, {})]
    mesh = load_mesh(gltf(tmp_path, materials, parts, ["a.png", "b.png"]))
    np.testing.assert_array_equal(mesh.texture_index, [0, 1, 2, -1, 0, -1])
    np.testing.assert_allclose([t[0, 0, 3] for t in mesh.textures], [128 / 255, 1, 0], rtol=1e-6)
    np.testing.assert_allclose(mesh.textures[0][0, 0, :3], [1, HALF, 0], rtol=1e-6)
    np.testing.assert_allclose(mesh.uv[:3], [[0, 1], [1, 1], [0, 0.25]])
    np.testing.assert_allclose(mesh.opacity[::3], [0.5, 1, 1, 1, 0.5, 1])
    np.testing.assert_allclose(mesh.color[::3, 0], [1, 1, 1, 0.5, 1, 0.8])


def test_scene_keys_replace_the_look_of_a_file(tmp_path):
    """A colour replaces the file's and its images' colours, an opacity their alpha, but not what is cut out."""
    Image.fromarray(np.array([[[255, 0, 0, 0], [255, 0, 0, 128]]], dtype=np.uint8)).save(tmp_path / "a.png")
    uv = {"TEXCOORD_0": np.float32([[0, 0], [1, 0], [0, 1]])}
    gltf(tmp_path, [material("BLEND", [1, 0, 0, 0.5], texture=0)], [(0, uv, {})], ["a.png"])
    camera = "[camera]\neye = [0, 0, 3]\ntarget = [0, 0, 0]\nfov = 45.0\n"
    scene = '[[object]]\nmesh = "scene.gltf"\n'
    (item,) = load_scene(write(tmp_path, "s.toml", camera + scene)).objects
    assert item.opacity == 0.5
    np.testing.assert_allclose(item.textures[0][0], [[1, 0, 0, 0], [1, 0, 0, 128 / 255]])
    (item,) = load_scene(write(tmp_path, "s.toml", camera + scene + "color = [0, 1, 0]\nopacity = 0.7\n")).objects
    assert item.opacity == 0.7
    np.testing.assert_array_equal(item.color, [0, 1, 0])
    np.testing.assert_array_equal(item.textures[0][0], [[1, 1, 1, 0], [1, 1, 1, 1]])


USD = """#usda 1.0
(
    upAxis = "Z"
)
def Xform "root"
{
    double3 xformOp:translate = (10, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "a"
    {
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4]
        uniform token subdivisionScheme = "none"
        %s
    }
}
"""


@pytest.fixture
def usd(tmp_path):
    """Return a function that loads a mesh of a quad and a triangle with the given attributes."""
    pytest.importorskip("pxr", reason="usd-core is not installed")

    def load(attributes="", text=USD):
        return load_mesh(write(tmp_path, "a.usda", text.replace("%s", attributes)))

    return load


def test_usd_geometry(usd):
    """World transforms apply, the up axis stays, polygons are fans, points stay as they are."""
    mesh = usd()
    np.testing.assert_allclose(
        mesh.vertices, [[10, 0, 0], [11, 0, 0], [11, 1, 0], [10, 1, 0], [10.5, 2, 0]], rtol=1e-12
    )
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    assert (mesh.color, mesh.opacity, mesh.normals) == (None, None, None)


def test_usd_display_color(usd):
    """Constant and per-point colours keep the points; a colour per face splits only the points that two faces share."""
    mesh = usd("color3f[] primvars:displayColor = [(1, 0.5, 0)]\nfloat[] primvars:displayOpacity = [0.25]")
    np.testing.assert_array_equal(mesh.color, [1, 0.5, 0])
    assert mesh.opacity == 0.25
    mesh = usd(
        "color3f[] primvars:displayColor = [(0, 0, 0), (0.1, 0, 0), (0.2, 0, 0), (0.3, 0, 0), (0.4, 0, 0)] "
        '(interpolation = "vertex")'
    )
    np.testing.assert_allclose(mesh.color[:, 0], [0, 0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    mesh = usd('color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "uniform")')
    assert len(mesh.vertices) == 7
    np.testing.assert_array_equal(mesh.color[mesh.faces][:, :, 0], [[1] * 3, [1] * 3, [0] * 3])
    np.testing.assert_allclose(mesh.vertices[mesh.faces[2]], [[10, 1, 0], [11, 1, 0], [10.5, 2, 0]])


def test_usd_corner_normals_that_agree_do_not_split(usd):
    """Normals per corner, the same wherever faces meet, leave one vertex a point."""
    mesh = usd(f'normal3f[] normals = [{", ".join(["(0, 0, 1)"] * 7)}] (interpolation = "faceVarying")')
    assert len(mesh.vertices) == 5
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 5)


def test_usd_preview_surface_gives_the_color(usd):
    """Without displayColor the constants of a bound UsdPreviewSurface count."""
    look = """
    def Material "look"
    {
        token outputs:surface.connect = </root/look/shader.outputs:surface>
        def Shader "shader"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.25, 0.5, 0.75)
            float inputs:opacity = 0.5
            token outputs:surface
        }
    }
}
"""
    text = USD.replace('Mesh "a"', 'Mesh "a" (prepend apiSchemas = ["MaterialBindingAPI"])').rstrip()[:-1] + look
    mesh = usd("rel material:binding = </root/look>", text)
    np.testing.assert_allclose(mesh.color, [0.25, 0.5, 0.75])
    assert mesh.opacity == 0.5


def test_usd_hidden_and_empty(usd):
    """Invisible meshes are left out; a stage without any says what it holds instead."""
    with pytest.raises(ValueError, match=r"got no faces in .*expected a mesh with triangles"):
        usd('token visibility = "invisible"')
    with pytest.raises(ValueError, match=r"it holds Sphere"):
        usd(text='#usda 1.0\ndef Sphere "s"\n{\n}\n')
    with pytest.raises(ValueError, match="got a USD file that cannot be read"):
        usd(text="nonsense")
    with pytest.raises(ValueError, match="its faces need 7 indices"):
        usd(text=USD.replace("3, 3, 2, 4]", "3, 3, 2]"))


def test_usd_references_stay_inside(usd, tmp_path):
    """A stage that refers to a file outside of the root is refused."""
    write(tmp_path, "outside.usda", '#usda 1.0\n( defaultPrim = "m" )\ndef Mesh "m"\n{\n}\n')
    inner = '#usda 1.0\ndef "x" (references = @../outside.usda@)\n{\n}\n'
    path = write(tmp_path / "in", "a.usda", inner)
    with pytest.raises(ValueError, match=r"got a reference to .*outside.usda in .*expected references inside"):
        load_mesh(path)


def test_missing_usd_core_is_named(tmp_path, monkeypatch):
    """Without usd-core the error says what to install."""
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match=r"pip install .?warpfrag\[usd\]"):
        load_mesh(write(tmp_path, "a.usda", USD))


def test_asset_of_the_warp_wheel():
    """The bunny: one vertex a point, y up, its own normals."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    mesh = load_mesh("warp:bunny.usd")
    assert (len(mesh.vertices), len(mesh.faces)) == (6102, 12200)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1.613, 1.619, 1.230], atol=1e-3)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.gltf", "{", "got a gltf file that cannot be read"),
        ("a.obj", "v 0 0 0\nf 1 2 3\n", "a.obj"),
        ("a.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj"),
        ("a.stl", "", "a.stl"),
        ("a.glb", "glTF", "got a glb file that cannot be read"),
        ("a.xyz", "", "of an unknown kind, expected one of .ply"),
    ],
)
def test_unreadable_files(tmp_path, name, text, words):
    """Broken, empty and unknown files are errors of one line that name the file."""
    with pytest.raises(ValueError, match=words) as caught:
        load_mesh(write(tmp_path, name, text))
    assert "\n" not in str(caught.value)
