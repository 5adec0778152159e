"""The study of layer budgets: what a surface among layers hides, the search by pixel, and the rule."""

import numpy as np
import pytest
from study_modules import EXPERIMENTS, study_modules

import warpfrag as wf

torch = pytest.importorskip("torch")
pytest.importorskip("matplotlib")

FOLDER = EXPERIMENTS / "fit" / "layer_budgets"


@pytest.fixture(scope="module")
def study():
    """The study's modules, and those of the study of transparency that they bring along."""
    with study_modules(FOLDER, ("budget", "deep_scenes", "maps"), ["shapes"]) as modules:
        yield modules


@pytest.fixture(scope="module")
def machine(study):
    """The machine, tiny."""
    return study.budget.Case("machine", study.deep_scenes.assembly(20))


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        # In front of all: the surface alone. The red slab is 2 … 4, half of it is in front at 3.
        (1.0, (1.0, 1.0, 1.0)),
        (3.0, (0.25 + 0.75, 0.75, 0.75)),
        # Behind red, before green; then behind both, at green's own depth included.
        (4.5, (0.5 + 0.5, 0.5, 0.5)),
        (5.0, (0.5 + 0.25, 0.25 + 0.25, 0.25)),
    ],
)
def test_surface_hides_what_is_behind_and_cuts_slabs(study, distance, expected):
    """A white surface among two layers of opacity 0.5, a slab and a sheet, worked by hand."""
    fragments = wf.Fragments.from_lists(
        [[(0.5, 0.0, 0.0, 0.5, 4.0, 2.0), (0.0, 0.5, 0.0, 0.5, 5.0, 0.0)]], (1, 1), np.float32
    )
    layers = wf.resolve(fragments.torch(), 1.0, max_layers=4)
    images = study.budget.with_surface(layers, np.array([distance]), (1.0, 1.0, 1.0, 1.0))
    # Rounding of float32.
    np.testing.assert_allclose(images[0, 0].numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(images[0, 1].numpy(), (0.75, 0.5, 0.25), atol=1e-6)


@pytest.mark.parametrize("method", ["SFM", "exact", "SKB+OFM"])
def test_as_many_layers_as_fragments_are_all_of_them(machine, method):
    """Without thickness and with room for all, layers are the reference, a surface inserted or not."""
    scores = machine.scores(method, int(machine.counts.max()) + 1, 0.0)
    # Rounding of float32 in up to 36 layers, in levels of 255.
    assert max(score["rms"] for score in scores.values()) < 1e-3


def test_k_buffer_takes_fragments_as_they_come(machine):
    """The layers are those of the bounded capture, which streams in order of submission."""
    # So thick that the order matters: thin slabs end in the same slots in any.
    expected = wf.storage.capture_kbuffer(machine.scene, slots=3, parameters={"thickness": 1000.0}).numpy()
    found = machine.layers("SKB+OFM", 3, 1000.0).numpy()
    np.testing.assert_array_equal(found.count, expected.count)
    # The bounded capture may round a thickness in another place.
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=1e-5)


@pytest.mark.parametrize("measure", ["image", "inserted"])
def test_no_thickness_of_the_grid_beats_the_search(study, machine, measure):
    """The map of the best by pixel gives the error that the search says, and the freer map is never the worse."""
    search = study.maps.Search.run(machine, "SKB+OFM", 4)
    maps = [np.full(400, search.one(measure)), search.blocks(measure, 5), search.pixels(measure)]
    errors = [machine.scores("SKB+OFM", 4, thickness)[measure]["rms"] for thickness in maps]
    assert errors[2] < errors[1] < errors[0]
    np.testing.assert_allclose(errors[2], machine.rms(search.squares[measure].min(axis=0)), rtol=1e-5)


def test_rule_wants_nothing_where_all_find_room(study, machine):
    """0 where n ≤ M; elsewhere the share of the extent, never more than the M-th largest gap."""
    thickness = study.maps.by_rule(machine, 4, 0.2)
    assert (thickness[machine.counts <= 4] == 0.0).all()
    assert (thickness[machine.counts > 4] > 0.0).all()
    assert (thickness <= study.maps.by_rule(machine, 4, 0.2, study.maps.RULES[1])).all()


@pytest.mark.parametrize("layer_count", [1, 2, 4])
def test_gap_leaves_as_many_layers(machine, layer_count):
    """Slabs as thick as the M-th largest gap form M runs, fewer only where gaps are equal."""
    layers = machine.layers("exact", 40, machine.gap(layer_count))
    found = layers.count.numpy().reshape(-1)
    assert (found <= np.minimum(machine.counts, layer_count)).all()
    assert (found == np.minimum(machine.counts, layer_count)).mean() > 0.9


def test_descent_goes_down_from_where_it_starts(study, machine):
    """Each pixel's best is no worse than the start, and the map of one step no better than that."""
    start = 0.05
    descent = study.maps.descend(machine, "SFM", 4, start, 3)
    errors = [
        machine.scores("SFM", 4, thickness)["inserted"]["rms"]
        for thickness in (descent.pixels, descent.together, np.full(400, start))
    ]
    assert errors[0] < errors[1] <= errors[2] * (1.0 + 1e-6)
    assert 0.1 < descent.moved <= 1.0
