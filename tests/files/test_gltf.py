"""glTF files as the specification says: accessors, primitives, nodes, materials, samplers, and what is refused."""

import io
import json
import warnings

import numpy as np
import pytest
from gltf_files import FACE, QUAD, TRIANGLE, UV, data_uri, looked_up, write_gltf, write_textured
from PIL import Image

from warpfrag.colors import encode
from warpfrag.files.meshes import load_mesh, load_parts

PLAIN = {"attributes": {"POSITION": 0}, "indices": 1}
RAMP = np.zeros((4, 4, 3), "u1")
RAMP[..., 0] = np.arange(4) * 60 + 40


def across(mesh, count, y=0.0):
    """Return the stored red of a square's image at the middles of `count` columns, from the left."""
    points = [(2.0 * (column + 0.5) / count - 1.0, y) for column in range(count)]
    rgba = looked_up(mesh, points)
    return encode(np.concatenate([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], axis=1)[None])[0, :, 0].tolist()


def test_whole_numbers_are_shares_where_they_say_so(tmp_path):
    """Texture coordinates and colours of 16 and 8 bits, and quantised positions, in every component type."""
    for kind, top in (("u1", 255), ("u2", 65535)):
        mesh = load_mesh(write_textured(tmp_path, RAMP, uv=(UV * top).astype(kind), normalized=(2,)))
        np.testing.assert_allclose(mesh.uv[:, 0], UV[FACES_OF_QUAD][:, 0])
    positions = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, -32768, 0, 0]], "i2")

    def quantised(document):
        document["accessors"][0]["type"] = "VEC3"
        document["bufferViews"][0]["byteStride"] = 8

    needed = {"extensionsRequired": ["KHR_mesh_quantization"], "extensionsUsed": ["KHR_mesh_quantization"]}
    mesh = load_mesh(write_gltf(tmp_path, [positions, FACE], PLAIN, normalized=(0,), edit=quantised, **needed))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, -1, 0]])
    mesh = load_mesh(write_gltf(tmp_path, [positions, FACE], PLAIN, edit=quantised, **needed))
    assert mesh.vertices.max() == 32767


FACES_OF_QUAD = [0, 1, 2, 0, 2, 3]


@pytest.mark.parametrize("material", [None, {}])
@pytest.mark.parametrize(
    ("colors", "expected"),
    [
        (np.array([[0.1, 0.2, 0.3, 0.5]] * 3, "f4"), [0.1, 0.2, 0.3]),
        (np.array([[6554, 13107, 19661, 65535]] * 3, "u2"), [6554 / 65535, 0.2, 19661 / 65535]),
        (np.array([[0.0005, 0.001, 0.0015]] * 3, "f4"), [0.0005, 0.001, 0.0015]),
        (np.array([[51, 102, 153]] * 3, "u1"), [0.2, 0.4, 0.6]),
    ],
)
def test_vertex_colours_are_linear_in_full_precision(tmp_path, material, colors, expected):
    """COLOR_0 is linear in every type, with and without a material; without one, all is opaque."""
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}
    document = {} if material is None else {"materials": [material]}
    if material is not None:
        primitive["material"] = 0
    mesh = load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE, colors], primitive, normalized=(2,), **document))
    np.testing.assert_allclose(mesh.color, [expected] * 3, rtol=1e-6)
    assert mesh.opacity == 1.0


def test_sparse_accessors(tmp_path):
    """Sparse values take the place of those of the buffer, or of zeros where there is none."""
    sparse = {"count": 1, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    arrays = [TRIANGLE, FACE, np.array([1], "u2"), np.array([[5, 0, 0]], "f4")]

    def edit(document):
        document["accessors"][0]["sparse"] = sparse

    np.testing.assert_array_equal(load_mesh(write_gltf(tmp_path, arrays, PLAIN, edit=edit)).vertices[1], [5, 0, 0])

    def only_sparse(document):
        edit(document)
        del document["accessors"][0]["bufferView"]

    np.testing.assert_array_equal(
        load_mesh(write_gltf(tmp_path, arrays, PLAIN, edit=only_sparse)).vertices, [[0, 0, 0], [5, 0, 0], [0, 0, 0]]
    )


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (5, [0, 1, 3, 2], [[0, 1, 3], [1, 2, 3]]),
        (6, [0, 1, 2, 3], [[0, 1, 2], [0, 2, 3]]),
        (4, [0, 1, 2, 0, 2, 3], [[0, 1, 2], [0, 2, 3]]),
        (5, [0, 1, 3, 3, 2], [[0, 1, 3]]),
    ],
)
def test_modes_of_triangles(tmp_path, mode, indices, faces):
    """Strips and fans give the triangles of the specification, all facing one way; empty ones are left out."""
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 2}, "indices": 1, "mode": mode}
    normals = np.tile(np.array([[0, 0, 1]], "f4"), (4, 1))
    mesh = load_mesh(write_gltf(tmp_path, [QUAD, np.array(indices, "u2"), normals], primitive))
    assert sorted(map(sorted, mesh.faces.tolist())) == sorted(map(sorted, faces))
    corners = mesh.vertices[mesh.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


def test_points_and_lines_are_named(tmp_path):
    """What has no triangles is told: in an error alone, in a warning beside triangles."""
    lines = {"attributes": {"POSITION": 0}, "mode": 1}
    with pytest.raises(ValueError, match=r"got no faces in .* \(it holds lines\)"):
        load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE], lines))
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, meshes=[{"primitives": [PLAIN, lines]}])
    with pytest.warns(UserWarning, match="lines are not drawn$"):
        assert len(load_mesh(path).faces) == 1


def test_morph_targets_have_their_default_weights(tmp_path):
    """Those of the mesh, or of the node that draws it."""
    primitive = {**PLAIN, "targets": [{"POSITION": 2}]}
    arrays = [TRIANGLE, FACE, np.array([[0, 0, 2]] * 3, "f4")]
    meshes = [{"primitives": [primitive], "weights": [0.5]}]
    assert load_mesh(write_gltf(tmp_path, arrays, primitive, meshes=meshes)).vertices[:, 2].tolist() == [1, 1, 1]
    nodes = [{"mesh": 0, "weights": [0.25]}]
    mesh = load_mesh(write_gltf(tmp_path, arrays, primitive, meshes=meshes, nodes=nodes))
    assert mesh.vertices[:, 2].tolist() == [0.5, 0.5, 0.5]


def test_skins_hold_their_rest_pose(tmp_path):
    """A skinned mesh stands where its joints are, whatever its own node says."""
    joints = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], "u1")
    weights = np.array([[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0]], "f4")
    inverse = np.tile(np.eye(4, dtype="f4").reshape(1, 16), (2, 1))
    primitive = {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 1}
    nodes = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {}, {"translation": [0, 0, 4]}]
    document = {"nodes": nodes, "scenes": [{"nodes": [0, 1, 2]}]}
    document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": 4}]
    mesh = load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE, joints, weights, inverse], primitive, **document))
    np.testing.assert_allclose(mesh.vertices, [[0, 0, 0], [1, 0, 4], [0, 1, 2]])


def test_missing_normals_are_those_of_the_faces(tmp_path):
    """Without NORMAL each face has its own; with it vertices are shared."""
    roof = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], "f4")
    arrays = [roof, np.array([0, 1, 2, 1, 3, 2], "u2")]
    mesh = load_mesh(write_gltf(tmp_path, arrays, PLAIN))
    np.testing.assert_allclose(mesh.normals[:3], [[0, 0, 1]] * 3)
    assert np.ptp(mesh.normals[3:], axis=0).max() == 0.0
    assert abs(mesh.normals[3] @ [0, 0, 1]) < 0.9


def test_mirrored_nodes_keep_their_outside(tmp_path):
    """A scale of −1 turns neither faces nor normals inside out."""
    normals = np.tile(np.array([[0, 0, 1]], "f4"), (3, 1))
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 2}, "indices": 1}
    for scale, sign in (([-1, 1, 1], 1), ([1, 1, -1], -1), ([-2, -2, -2], -1)):
        nodes = [{"mesh": 0, "scale": scale}]
        mesh = load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE, normals], primitive, nodes=nodes))
        a, b, c = mesh.vertices[mesh.faces[0]]
        assert np.sign(np.cross(b - a, c - a)[2]) == sign
        assert np.sign(mesh.normals[:, 2]).tolist() == [sign] * 3


def test_nodes_turn_instances_and_hidden_nodes(tmp_path):
    """Matrices multiply down the tree; instances are drawn at each place; invisible nodes and other scenes are not."""
    turn = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "translation": [0, 0, 3]}
    nodes = [{"children": [1], **turn}, {"mesh": 0, "translation": [1, 0, 0]}, {"mesh": 0, "translation": [0, 0, 99]}]
    scenes = [{"nodes": [2]}, {"nodes": [0]}]
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, nodes=nodes, scenes=scenes, scene=1)
    with pytest.warns(UserWarning, match="scenes other than scene 1 are not drawn"):
        np.testing.assert_allclose(load_mesh(path).vertices, [[0, 1, 3], [0, 2, 3], [-1, 1, 3]], atol=1e-12)
    places = np.array([[10, 0, 0], [20, 0, 0]], "f4")
    name = "EXT_mesh_gpu_instancing"
    nodes = [{"mesh": 0, "translation": [0, 5, 0], "extensions": {name: {"attributes": {"TRANSLATION": 2}}}}]
    mesh = load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE, places], PLAIN, nodes=nodes, extensionsRequired=[name]))
    np.testing.assert_array_equal(mesh.vertices[[0, 3]], [[10, 5, 0], [20, 5, 0]])
    hidden = [{"mesh": 0}, {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}]
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, nodes=hidden, scenes=[{"nodes": [0, 1]}])
    assert len(load_mesh(path).faces) == 1


def test_parts_have_the_names_of_their_nodes(tmp_path):
    """Each node is a part; without a name of its own it takes that of its mesh."""
    meshes = [{"primitives": [PLAIN], "name": "shape"}]
    nodes = [{"mesh": 0, "name": "lid"}, {"mesh": 0}, {"name": "empty"}]
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, meshes=meshes, nodes=nodes, scenes=[{"nodes": [0, 1, 2]}])
    assert [part.name for part in load_parts(path)] == ["lid", "shape"]


def test_texture_transforms_and_coordinate_sets(tmp_path):
    """Offset, scale and turn are applied to the set that is meant, the extension's own before the texture's."""
    transform = {"offset": [0.5, 0.0], "scale": [0.5, 0.5]}
    info = {"extensions": {"KHR_texture_transform": transform}}
    assert across(load_mesh(write_textured(tmp_path, RAMP, info=info)), 2) == [160, 220]
    # The image turns clockwise, seen with v down: what was to the left is at the top.
    info = {"extensions": {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0.0, 1.0]}}}
    mesh = load_mesh(write_textured(tmp_path, RAMP, info=info))
    top, bottom = looked_up(mesh, [(0.0, 0.75), (0.0, -0.75)])
    assert [encode(rgba[None, None])[0, 0, 0] for rgba in (top, bottom)] == [40, 220]
    other = {"attributes": {"TEXCOORD_1": 3}, "arrays": [UV * 0.5]}
    half = across(load_mesh(write_textured(tmp_path, RAMP, info={"texCoord": 1}, **other)), 2)
    assert half == [40, 100]
    info = {"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    assert across(load_mesh(write_textured(tmp_path, RAMP, info=info, **other)), 2) == half


@pytest.mark.parametrize(
    ("mode", "uv", "expected"),
    [
        (33071, UV * 2 - 0.5, [40, 40, 40, 100, 160, 220, 220, 220]),
        (33648, UV * 2, [40, 100, 160, 220, 220, 160, 100, 40]),
        (10497, UV * 2, [40, 100, 160, 220] * 2),
    ],
)
def test_wrap_modes(tmp_path, mode, uv, expected):
    """Images are clamped, mirrored or repeated as their samplers say, the one way or the other."""
    document = {"samplers": [{"wrapS": mode}], "textures": [{"source": 0, "sampler": 0}]}
    mesh = load_mesh(write_textured(tmp_path, RAMP, uv=uv.astype("f4"), **document))
    assert across(mesh, 8, y=0.1) == expected
    document["samplers"] = [{"wrapT": mode}]
    mesh = load_mesh(write_textured(tmp_path, RAMP.transpose(1, 0, 2), uv=uv.astype("f4"), **document))
    points = [(0.1, 1.0 - 2.0 * (row + 0.5) / 8) for row in range(8)]
    assert [encode(rgba[None, None])[0, 0, 0] for rgba in looked_up(mesh, points)] == expected


def test_clamped_edges_do_not_take_the_other_side(tmp_path):
    """At the very edge of a clamped image its own texel counts alone."""
    document = {"samplers": [{"wrapS": 33071, "wrapT": 33071}], "textures": [{"source": 0, "sampler": 0}]}
    mesh = load_mesh(write_textured(tmp_path, RAMP, **document))
    left, right = looked_up(mesh, [(-1.0, 0.0), (1.0, 0.0)])
    assert [encode(rgba[None, None])[0, 0, 0] for rgba in (left, right)] == [40, 220]


def test_nearest_texels(tmp_path):
    """Without interpolation a texel has its colour up to its edge."""
    document = {"samplers": [{"magFilter": 9728}], "textures": [{"source": 0, "sampler": 0}]}
    mesh = load_mesh(write_textured(tmp_path, RAMP, **document))
    assert across(mesh, 32) == np.repeat([40, 100, 160, 220], 8).tolist()


def test_masks(tmp_path):
    """Cut where factor · vertex alpha · interpolated image alpha falls below the cut-off; what stays is opaque."""
    mask = {"alphaMode": "MASK", "alphaCutoff": 0.75}
    pixels = np.full((1, 4, 4), 255)
    pixels[0, :2, 3] = 0
    middles = [((column + 0.5) / 8 - 1.0, 0.0) for column in range(16)]
    alpha = looked_up(load_mesh(write_textured(tmp_path, pixels, material=mask)), middles)[:, 3]
    # 0.75 is reached a quarter of a texel behind the middle of the third of four, and left as far before the edge.
    assert alpha.tolist() == [0.0] * 9 + [1.0] * 6 + [0.0]
    colors = np.array([[1, 1, 1, a] for a in (0, 0, 1, 1)], "f4")
    for image_alpha in (255, 204):
        pixels = np.full((2, 2, 4), image_alpha)
        mask = {"alphaMode": "MASK", "alphaCutoff": 0.5 * image_alpha / 255}
        more = {"attributes": {"COLOR_0": 3}, "arrays": [colors], "material": mask}
        mesh = load_mesh(write_textured(tmp_path, pixels, **more))
        # The upper half of the square is left, opaque.
        corners = mesh.vertices[mesh.faces]
        assert mesh.vertices[np.unique(mesh.faces)][:, 1].min() == pytest.approx(0.0, abs=1e-6)
        areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
        assert areas.sum() == pytest.approx(2.0)
        assert areas.min() > 0.0
        assert (mesh.opacity, mesh.textures[0][..., 3].min()) == (1.0, 1.0)


def test_opaque_ignores_alpha(tmp_path):
    """Neither vertices nor images nor factors make an OPAQUE surface translucent."""
    colors = np.full((4, 4), 0.5, "f4")
    more = {"attributes": {"COLOR_0": 3}, "arrays": [colors]}
    mesh = load_mesh(write_textured(tmp_path, np.full((2, 2, 4), 128), **more))
    assert (mesh.opacity, mesh.textures[0][..., 3].min()) == (1.0, 1.0)
    mesh = load_mesh(write_textured(tmp_path, np.full((2, 2, 4), 128), material={"alphaMode": "BLEND"}, **more))
    assert mesh.opacity == 0.5
    np.testing.assert_allclose(mesh.textures[0][..., 3], 128 / 255, rtol=1e-6)


def test_images_are_srgb_whatever_they_say(tmp_path):
    """A gamma in a PNG does not count in a glTF."""
    stream = io.BytesIO()
    from PIL.PngImagePlugin import PngInfo

    extra = PngInfo()
    extra.add(b"gAMA", (100000).to_bytes(4, "big"))
    Image.fromarray(RAMP).save(stream, "PNG", pnginfo=extra)
    images = [{"uri": data_uri(stream.getvalue(), "image/png")}]
    assert across(load_mesh(write_textured(tmp_path, RAMP, images=images)), 4) == [40, 100, 160, 220]


def test_specular_glossiness_has_its_own_colour(tmp_path):
    """The diffuse factor of the older kind of material is the colour."""
    name = "KHR_materials_pbrSpecularGlossiness"
    materials = [{"extensions": {name: {"diffuseFactor": [0.1, 0.2, 0.3, 1.0]}}}]
    primitive = {**PLAIN, "material": 0}
    mesh = load_mesh(write_gltf(tmp_path, [TRIANGLE, FACE], primitive, materials=materials, extensionsRequired=[name]))
    np.testing.assert_allclose(mesh.color, [0.1, 0.2, 0.3])


def test_required_extensions_are_refused_by_name(tmp_path):
    """What a file requires and no reader here does is refused; what it only uses is named in a warning."""
    path = write_gltf(
        tmp_path, [TRIANGLE, FACE], PLAIN, extensionsRequired=["VENDOR_unknown", "EXT_meshopt_compression"]
    )
    with pytest.raises(ValueError, match="it requires VENDOR_unknown, EXT_meshopt_compression, which is not supported"):
        load_mesh(path)
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, extensionsUsed=["KHR_materials_clearcoat"])
    with pytest.warns(UserWarning, match="a.gltf: KHR_materials_clearcoat is not supported, drawn without$"):
        load_mesh(path)
    path = write_textured(tmp_path, RAMP, textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}])
    with pytest.warns(UserWarning, match="texture: KHR_texture_basisu is not supported, drawn without$"):
        assert load_mesh(path).textures == []


def test_draco(tmp_path):
    """Geometry compressed by Draco is read through DracoPy."""
    draco = pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    data = draco.encode(np.asarray(QUAD, "f4"), np.array([[0, 1, 2], [0, 2, 3]], "u4"), quantization_bits=16)
    name = "KHR_draco_mesh_compression"
    packed = {"bufferView": 2, "attributes": {"POSITION": 0}}
    primitive = {**PLAIN, "extensions": {name: packed}}
    arrays = [QUAD, np.array([0, 1, 2, 0, 2, 3], "u2"), np.frombuffer(data, "u1")]

    def edit(document):
        for accessor in document["accessors"][:2]:
            del accessor["bufferView"]

    mesh = load_mesh(write_gltf(tmp_path, arrays, primitive, edit=edit, extensionsRequired=[name]))
    assert len(mesh.faces) == 2
    np.testing.assert_allclose(np.sort(np.unique(mesh.vertices.round(3), axis=0)[:, 0]), [-1, -1, 1, 1], atol=1e-3)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda d: d["accessors"][0].update(count=10**12), "which is too short"),
        (lambda d: d["accessors"][0].update(count=10**12, bufferView=None), "expected what fits into"),
        (lambda d: d["accessors"][1].update(bufferView=7), 'the index 7 into "bufferViews", of which there are 2'),
        (lambda d: d["nodes"].append({"children": [1]}) or d["scenes"][0].update(nodes=[1]), "two places"),
        (lambda d: d["asset"].update(version="1.0"), "glTF version 1.0, expected 2.0"),
        (lambda d: d["buffers"][0].update(uri="no.bin"), "the data of buffer 0 is missing.*cannot find no.bin"),
    ],
)
def test_broken_documents(tmp_path, edit, words):
    """Counts, indices and trees that cannot be are one line that names the file."""
    path = write_gltf(tmp_path, [TRIANGLE, FACE], PLAIN, edit=edit)
    with pytest.raises(ValueError, match=rf"got a gltf file that cannot be read: .*a.gltf \(.*{words}") as caught:
        load_mesh(path)
    assert "\n" not in str(caught.value)


def test_one_warning_a_file(tmp_path):
    """All that is left out stands in one line."""
    document = json.loads(write_textured(tmp_path, RAMP, extensionsUsed=["KHR_materials_sheen"]).read_text())
    document["images"] = [{"uri": "gone.png"}]
    document["materials"][0]["emissiveFactor"] = [1, 0, 0]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        load_mesh(tmp_path / "a.gltf")
    (warning,) = told
    words = "cannot find gone.png; KHR_materials_sheen is not supported, drawn without; the light that materials emit"
    assert words in str(warning.message)
    assert "\n" not in str(warning.message)
