"""The files that example scenes name are those that the script beside the docs makes."""

import sys
from pathlib import Path

import numpy as np

from warpfrag.files.images import read_texture
from warpfrag.files.meshes import load_parts
from warpfrag.files.points import load_points
from warpfrag.files.scene_file import load_scene

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "scenes"
sys.path.insert(0, str(ROOT / "docs"))

import make_assets  # noqa: E402


def test_assets_are_as_the_script_makes_them(tmp_path, monkeypatch):
    """The script writes the shipped files again, and no others lie there."""
    monkeypatch.setattr(make_assets, "ASSETS", tmp_path)
    make_assets.main()
    shipped = {path.name: path for path in (SCENES / "assets").iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == set(shipped)
    # Other machines round sines differently.
    for ours, theirs in zip(load_parts(tmp_path / "egg.glb"), load_parts(shipped["egg.glb"]), strict=True):
        assert ours.name == theirs.name
        np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-6)
    ours, theirs = (load_points(path) for path in (tmp_path / "moebius.ply", shipped["moebius.ply"]))
    for name in ("points", "normals", "color"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6)
    # Pillow's versions compress differently.
    assert (read_texture(tmp_path / "lattice.png") == read_texture(shipped["lattice.png"])).all()


def test_nodes_become_objects():
    """The egg's three nodes are objects with the thicknesses that the scene gives each of them."""
    objects = load_scene(SCENES / "egg.toml").objects
    assert {item.name: item.thickness for item in objects} == {"egg.shell": 0.2, "egg.white": 0.5, "egg.yolk": 1.0}
