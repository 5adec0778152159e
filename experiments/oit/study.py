"""The order-independent transparency study: renders and measures, and writes data that figures.py draws.

    uv run python experiments/oit/study.py && uv run python experiments/oit/figures.py

Scenes are generated; `--model PATH` (again for more) puts mesh or point files in the place of the generated ones in
Fig. 10, 12 and 13, `--points PATH` a point set in the place of the bunny of Fig. 11.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

# Warp's notes about devices and modules are not part of the study's output.
wp.config.log_level = wp.LOG_WARNING

import methods  # noqa: E402
import study_scenes as scenes  # noqa: E402
from methods import BETA, COMPARED, OTHERS, SLOTS, over_background  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.capture.surfaces import place_surfaces  # noqa: E402
from warpfrag.files.saving import replacing  # noqa: E402
from warpfrag.raster.ray import Window  # noqa: E402
from warpfrag.scene.assemble import assemble  # noqa: E402
from warpfrag.storage.method import count_fragments, scan_counts  # noqa: E402

RESULTS = Path("results") / "oit"
# Multiples of P(z) and numbers of slots that errors are measured at, beside the paper's 100 and 8.
MULTIPLES = (2.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
SLOT_COUNTS = (2, 4, 8, 16, 32, 64)
# Layers that lie farther apart than this are separate to the eye [scene units].
GAP = 0.06
Output = tuple[dict[str, np.ndarray], dict[str, Any]]


@dataclass(frozen=True)
class Settings:
    """What is rendered, and how large.

    Attributes:
        size: edge of the images [pixels]; Fig. 12 takes 2 and 4 times as many.
        detail: share of the generated scenes' parts, strands and points.
        models: files in the place of the generated scenes.
        view: direction from which those files are seen.
        points: point file in the place of the bunny.
        repetitions: how often passes are timed.
    """

    size: int = 512
    detail: float = 1.0
    models: tuple[Path, ...] = ()
    view: tuple[float, ...] = scenes.VIEW
    points: Path | None = None
    repetitions: int = 2

    def complex_scenes(self, size: int | None = None) -> Iterator[tuple[str, wf.Scene]]:
        """Yield the scenes of high depth complexity, one at a time."""
        size = size or self.size
        for path in self.models:
            yield path.stem, scenes.of_model(path, size, self.view)
        if not self.models:
            yield "engine", scenes.engine(size, self.detail)
            yield "hair ball", scenes.hair_ball(size, strands=max(int(100_000 * self.detail), 1))
            yield "floor", scenes.floor(size, count=max(int(60_000 * self.detail), 1))


def figure_1(settings: Settings) -> Output:
    """Intersections and coplanar surfaces: individual fragments, moments, and merging at the paper's 2 P(z)."""
    return _panels(
        scenes.with_thickness(scenes.from_file("sphere_and_cubes", settings.size), 2.0),
        {"over": methods.reference, "MBT": COMPARED["MBT"], "SFM": methods.merged("smooth")},
    )


def figure_3(settings: Settings) -> Output:
    """Two superimposed cubes without and with merging at 2 P(z)."""
    return _panels(
        scenes.with_thickness(scenes.from_file("coplanar_cubes", settings.size), 2.0),
        {"over": methods.reference, "SFM": methods.merged("smooth")},
    )


def figure_6(settings: Settings) -> Output:
    """Crossing cylinders, merged smoothly and order-independently."""
    ways = {"over": methods.reference, "SFM": methods.merged("smooth"), "OFM": methods.merged("order_independent")}
    return _panels(scenes.from_file("two_cylinders", settings.size), ways)


def figure_7(settings: Settings) -> Output:
    """Crossing spheres at three values of beta."""
    return _panels(scenes.from_file("sphere_pair", settings.size), _betas(0.0, 0.5, 1.0))


def figure_8(settings: Settings) -> Output:
    """Opacity of the front part of a slab, as the package has it: the absorbance along a ray through one fragment."""
    arrays = {}
    for opacity in (0.5, 0.99):
        for beta in (0.0, 0.25, 0.5, 0.75, 1.0):
            slab = wf.Fragments.from_lists([[(0.0, 0.0, 0.0, opacity, 1.0, 1.0)]], (1, 1), np.float64)
            arrays[f"{opacity} {beta}"] = wf.absorbance(slab, (0, 0), beta).at(np.linspace(0.0, 1.0, 201))
    return arrays, {}


def figure_9(settings: Settings) -> Output:
    """Spheres in a sphere, all nearly opaque, at four values of beta."""
    return _panels(scenes.from_file("spheres_in_sphere", settings.size), _betas(0.0, 0.3, 0.6, 1.0))


def figure_10(settings: Settings) -> Output:
    """Images and errors of every method against the sorted A-buffer, and errors by thickness and by slots."""
    arrays: dict[str, np.ndarray] = {}
    numbers: dict[str, Any] = {}
    for name, scene in settings.complex_scenes():
        capture = methods.capture(scene)
        covered = np.diff(capture.fragments.offsets).reshape(capture.fragments.shape) > 0
        exact = over_background(methods.reference(capture), scene)
        arrays[f"{name}/DFB"] = _bytes(exact)
        measured = {}
        for way, method in (COMPARED | OTHERS).items():
            image = over_background(method(capture), scene)
            measured[way] = methods.errors(image, exact, covered)
            if way in COMPARED:
                arrays[f"{name}/{way}"] = _bytes(image)
                arrays[f"{name}/{way}/difference"] = methods.difference(image, exact).astype(np.float16)
            _say(f"  {name}, {way}: mean error {measured[way]['mean']:.3f} levels")
        by_multiple: dict[str, dict[float, float]] = {"SKB+OFM": {}, "DFB+SFM": {}, "exact": {}}
        for multiple in MULTIPLES:
            thick = methods.scaled_thickness(capture, multiple / scenes.THICKNESS)
            for way, row in by_multiple.items():
                image = over_background(COMPARED[way](thick), scene)
                row[multiple] = methods.errors(image, exact, covered)["mean"]
        by_slots: dict[str, dict[int, float]] = {"SKB": {}, "SKB+OFM": {}}
        for slots in SLOT_COUNTS:
            for way, merge in (("SKB", "none"), ("SKB+OFM", "order_independent")):
                image = over_background(methods.kbuffer(merge, slots=slots)(capture), scene)
                by_slots[way][slots] = methods.errors(image, exact, covered)["mean"]
        numbers[name] = {
            "objects": len(scene.objects),
            "triangles": scenes.triangle_count(scene),
            "layers": methods.layer_counts(capture.fragments),
            "errors": measured,
            "by multiple": by_multiple,
            "by slots": by_slots,
        }
    return arrays, numbers


def figure_11(settings: Settings) -> Output:
    """The bunny as large surfels with coplanar text, merged at 2 P(z) as in the paper, and at 100."""
    scene = scenes.occlusion(settings.size, count=max(int(30_000 * settings.detail), 2), points=settings.points)
    thin = methods.capture(scenes.with_thickness(scene, 2.0))
    thick = methods.scaled_thickness(thin, scenes.THICKNESS / 2.0)
    covered = np.diff(thin.fragments.offsets).reshape(thin.fragments.shape) > 0
    # What the paper calls DFB leaves coplanar fragments in an order of their rounding: so does over.
    ways = {"DFB": (methods.reference, thin), "MBT": (COMPARED["MBT"], thin), "SKB": (COMPARED["SKB"], thin)}
    ways |= {"DFB+SFM": (COMPARED["DFB+SFM"], thin)}
    ways |= {"SKB+OFM": (COMPARED["SKB+OFM"], thin), "SKB+OFM, 100P": (COMPARED["SKB+OFM"], thick)}
    images = {way: over_background(method(capture), scene) for way, (method, capture) in ways.items()}
    measured = {way: methods.errors(image, images["DFB+SFM"], covered) for way, image in images.items()}
    numbers = {"layers": methods.layer_counts(thin.fragments), "errors": measured}
    return {way: _bytes(image) for way, image in images.items()}, numbers


def figure_12(settings: Settings) -> Output:
    """Time of each pass, from scenes that are assembled already, at two sizes."""
    numbers: dict[str, Any] = {}
    # Compiles and loads the kernels.
    _passes(scenes.from_file("three_spheres", 32), 1)
    for size in (2 * settings.size, 4 * settings.size):
        for name, scene in settings.complex_scenes(size):
            numbers[f"{name} {size}"] = timed = _passes(scene, settings.repetitions)
            total = {way: sum(passes.values()) for way, passes in timed["seconds"].items()}
            _say(f"  {name}, {size}²: " + ", ".join(f"{way} {seconds:.2f} s" for way, seconds in total.items()))
    return {}, numbers


def figure_13(settings: Settings) -> Output:
    """Absorbance along the ray that meets the most separate layers of the last scene: the floor."""
    *_, (name, scene) = settings.complex_scenes()
    capture = methods.capture(scene)
    fragments = capture.fragments
    pixel, layers = _most_separate(fragments)
    count = int(np.diff(fragments.offsets).reshape(fragments.shape)[pixel])
    surfaces = replace(fragments, thickness=np.zeros_like(fragments.thickness))
    plain = wf.kbuffer(capture.stream, SLOTS, merge="none")
    curves = {
        "DFB": wf.absorbance(surfaces, pixel),
        "SKB": wf.absorbance(plain, pixel, BETA),
        "SKB+OFM": wf.absorbance(wf.kbuffer(capture.stream, SLOTS), pixel, BETA),
        "DFB+SFM": wf.absorbance(fragments, pixel, BETA, merge="smooth", max_layers=SLOTS),
        "exact": wf.absorbance(fragments, pixel, BETA, merge="exact", max_layers=SLOTS),
    }
    arrays = {"image": _bytes(over_background(methods.reference(capture), scene))}
    nearest, farthest = curves["DFB"].depth[[0, -1]]
    margin = 0.04 * (farthest - nearest)
    grid = np.linspace(nearest - margin, farthest + margin, 2001)
    truth = curves["DFB"].at(grid)
    off = {}
    for way, curve in curves.items():
        arrays[f"{way}/depth"], arrays[f"{way}/absorbance"] = curve.depth, curve.absorbance
        off[way] = float(np.abs(curve.at(grid) - truth).mean())
    for number in (4, 8):
        curve = 1.0 - wf.baselines.moment_transmittance(fragments, pixel, grid, moments=number)
        way = f"MBT, {number} moments"
        arrays[f"{way}/depth"], arrays[f"{way}/absorbance"] = grid, curve
        off[way] = float(np.abs(curve - truth).mean())
    numbers = {"scene": name, "pixel": [int(at) for at in pixel], "fragments": count, "separate layers": layers}
    return arrays, {**numbers, "mean difference": off}


FIGURES: dict[str, Callable[[Settings], Output]] = {
    name.removeprefix("figure_"): function for name, function in list(globals().items()) if name.startswith("figure_")
}


def _panels(scene: wf.Scene, ways: dict[str, methods.Method]) -> Output:
    capture = methods.capture(scene)
    return {way: _bytes(over_background(method(capture), scene)) for way, method in ways.items()}, {}


def _betas(*betas: float) -> dict[str, methods.Method]:
    def at(beta: float) -> methods.Method:
        return lambda capture: wf.composite(capture.fragments, beta, max_layers=SLOTS, merge="smooth")

    return {f"{beta:g}": at(beta) for beta in betas}


def _passes(scene: wf.Scene, repetitions: int) -> dict[str, Any]:
    """Return the median time of the passes of each method [s], and the number of fragments.

    The store pass of the A-buffer shades as well. The sorting of its fragments is part of its resolve pass, as in the
    paper; the time of the count pass is measured alone and taken off that of a capture, which counts too.
    """
    window = Window.of(scene.camera)
    taken: dict[str, dict[str, list[float]]] = {
        way: {name: [] for name in names}
        for way, names in {
            "DFB": ("count", "store", "resolve"),
            "DFB+SFM": ("count", "store", "resolve"),
            "DFB+exact": ("count", "store", "resolve"),
            "SKB": ("store", "resolve"),
            "SKB+OFM": ("store", "resolve"),
        }.items()
    }
    fragment_count = 0
    place, _ = _timed(lambda: place_surfaces(assemble(scene)))
    for _ in range(repetitions):
        times: dict[str, dict[str, float]] = {way: {} for way in taken}
        surfaces = place_surfaces(assemble(scene))
        count, (_, fragment_count) = _timed(lambda s=surfaces: scan_counts(count_fragments(s.triangles(window))))
        del surfaces
        capture, fragments = _timed(lambda: wf.capture(scene, sort=False))
        store = max(capture - place - count, 0.0)
        for way, options in (
            ("DFB", {"merge": "none"}),
            ("DFB+SFM", {"merge": "smooth", "beta": BETA}),
            ("DFB+exact", {"merge": "exact", "beta": BETA}),
        ):
            resolve, _ = _timed(lambda f=fragments, o=options: wf.composite(f, max_layers=SLOTS, **o))
            times[way] = {"count": count, "store": store, "resolve": resolve}
        del fragments
        for way, merge in (("SKB", "none"), ("SKB+OFM", "order_independent")):
            store, layers = _timed(lambda m=merge: wf.storage.capture_kbuffer(scene, slots=SLOTS, merge=m))
            resolve, _ = _timed(lambda l=layers: wf.composite(l))  # noqa: E741
            times[way] = {"store": max(store - place, 0.0), "resolve": resolve}
            del layers
        for way, passes in times.items():
            for name, seconds in passes.items():
                taken[way][name].append(seconds)
    medians = {way: {name: statistics.median(each) for name, each in row.items()} for way, row in taken.items()}
    return {"seconds": medians, "fragments": int(fragment_count), "pixels": window.pixel_count}


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = function()
    wp.synchronize()
    return time.perf_counter() - start, result


def _most_separate(fragments: wf.Fragments) -> tuple[tuple[int, int], int]:
    """Return the pixel whose fragments, sorted, have the most gaps, of those the one with the most fragments."""
    counts = np.diff(fragments.offsets)
    far = np.concatenate([[False], np.diff(fragments.depth) > GAP])
    # The first fragment of a pixel begins a layer whatever lies before it.
    far[fragments.offsets[:-1][counts > 0]] = True
    begun = np.concatenate([[0], np.cumsum(far)])
    layers = begun[fragments.offsets[1:]] - begun[fragments.offsets[:-1]]
    best = int(np.lexsort((counts, layers))[-1])
    row, column = divmod(best, fragments.shape[1])
    return (row, column), int(layers[best])


def _bytes(levels: np.ndarray) -> np.ndarray:
    return np.round(levels).astype(np.uint8)


def _say(words: str) -> None:
    print(words, flush=True)


def run(settings: Settings, folder: Path, only: list[str] | None = None) -> None:
    """Compute figures and write their data: arrays, and numbers with the settings they were made with."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in only or list(FIGURES):
        _say(f"Fig. {name}: {(FIGURES[name].__doc__ or '').splitlines()[0]}")
        start = time.perf_counter()
        arrays, numbers = FIGURES[name](settings)
        seconds = time.perf_counter() - start
        with replacing(folder / f"fig{name}.npz") as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)
        about = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(settings).items()}
        about["models"] = [path.name for path in settings.models]
        document = {"settings": about, "numbers": numbers, "seconds": round(seconds, 1)}
        with replacing(folder / f"fig{name}.json") as temporary:
            Path(temporary).write_text(json.dumps(document, indent=1) + "\n")
        _say(f"  {seconds:.1f} s")


def main(arguments: list[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, action="append", default=[], help="mesh or point file; again for more")
    parser.add_argument(
        "--view", type=float, nargs=3, default=scenes.VIEW, help="where models are seen from, a direction"
    )
    parser.add_argument("--points", type=Path, help="point file for Fig. 11")
    parser.add_argument("--size", type=int, default=512, help="edge of the images [pixels] (512)")
    parser.add_argument("--detail", type=float, default=1.0, help="share of generated parts, strands, points (1)")
    parser.add_argument("--repetitions", type=int, default=2, help="how often passes are timed (2)")
    parser.add_argument(
        "--only", action="append", choices=list(FIGURES), metavar="FIG", help="this figure; again for more"
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"folder for the data ({RESULTS})")
    given = parser.parse_args(arguments)
    settings = Settings(
        *(given.size, given.detail, tuple(given.model), tuple(given.view), given.points, given.repetitions)
    )
    run(settings, given.out, given.only)


if __name__ == "__main__":
    main()
