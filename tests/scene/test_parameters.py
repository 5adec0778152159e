"""Kinds of parameters: each described once, and the same after a copy."""

import copy
import pickle

import numpy as np
import pytest
import torch
from small_scene import spheres

from warpfrag.render import render
from warpfrag.scene.camera import Camera
from warpfrag.scene.parameters import FOV, KINDS, THICKNESS, describe, kind_named, parse_thickness
from warpfrag.scene.same import same


def test_every_kind_is_found_by_name():
    """By owner and key; copied and pickled it is the kind itself."""
    names = {"scene": "{}", "object": "ball.{}", "camera": "camera.{}"}
    for kind in KINDS:
        assert kind_named(names[kind.owner].format(kind.key)) is kind
        assert copy.deepcopy(kind) is pickle.loads(pickle.dumps(kind)) is kind


def test_shapes_are_those_of_what_there_is_a_value_for():
    """One value, vertices, pixels; those of several views stacked."""
    known = describe(spheres(1).objects, Camera((0, 0, 3), (0, 0, 0), fov=40))
    count = len(spheres(1).objects[0].vertices)
    assert known["red.color"].shapes((6, 8)) == {"object": (3,), "vertex": (count, 3)}
    assert known["red.thickness"].shapes((6, 8), 2) == {"object": (), "vertex": (count,), "pixel": (2, 6, 8)}
    assert known["camera.rotation"].shapes((6, 8), 2) == {"object": (3,), "view": (2, 3)}
    assert known["camera.fov"].kind is FOV
    assert known["red.thickness"].kind is THICKNESS


@pytest.mark.parametrize("text", ["", "P", "2Q", "1e999P", "nan", "1,2"])
def test_texts_that_are_no_thickness(text):
    """Give none."""
    assert parse_thickness(text) is None


def test_optimising_just_works():
    """Adam on colours, opacity and thickness that leave their ranges: no error, and they come back."""
    scene = spheres(2, size=(16, 14))
    reference = torch.tensor(render(scene, parameters={"red.color": [1.0, 0.0, 0.0], "green.opacity": 1.0}))
    values = {"red.color": [0.5, 0.5, 0.5], "green.opacity": 0.9, "red.thickness": 0.05}
    leaves = {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}
    optimizer = torch.optim.Adam(leaves.values(), lr=0.1)
    strayed = False
    for _ in range(60):
        optimizer.zero_grad()
        loss = (render(scene, parameters=leaves) - reference).square().mean()
        loss.backward()
        optimizer.step()
        strayed |= bool((leaves["red.color"] < 0.0).any())
    assert strayed
    assert float(loss) < 1e-5


def test_same_compares_what_is_inside():
    """Arrays by their numbers, mappings and sequences part by part."""
    assert same({"a": [np.ones(2), np.nan * np.ones(1)]}, {"a": [np.array([1, 1]), np.nan * np.ones(1)]})
    assert not same({"a": np.ones(2)}, {"a": np.ones(3)})
    assert not same([1, 2], [1, 2, 3])
    assert not same({"a": 1}, {"b": 1})
