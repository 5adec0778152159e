"""Antialiased intersections against a renderer that is not ours: is pyrender's image ours, and are the fits the same?

Data goes to results/fit/opengl, pictures to figures/, the reference image to reference.png, the numbers to README.md.
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
from comparison import Comparison, NoOpenGLError, compare, on_grid  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.files.images import write_image  # noqa: E402
from warpfrag.fit import FitParameter, FitResult, Reference, Study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.samples import over_background  # noqa: E402
from warpfrag.studies.summary import Figure, Summary, Table  # noqa: E402

HERE = Path(__file__).parent
ANTIALIASING = HERE.parent / "antialiasing"
sys.path.append(str(ANTIALIASING))

from footprint import intersection_band, nearest_pairs  # noqa: E402

RESULTS = Path("results") / "fit" / "opengl"
SAMPLES = 8
BETA, THICKNESS = 0.9, 0.05
# Differences of values below this are taken relative to it.
SMALL = 1e-2
# Maps by Adam: steps, its rate.
STEPS, LEARNING_RATE = 150, 0.05
# The rule of the antialiasing study holds this far from an intersection [pixels].
REACH = 2.0
KINDS = {"scene": "global", "object": "per object", "pixel": "per pixel"}
OTHER_EYE = (-2.2, 2.4, 2.1)
GIVEN, SNAPPED = "as given", "on OpenGL's grid"


@dataclass(frozen=True, eq=False)
class Case:
    """A scene from a view, and all that is measured there.

    Attributes:
        name: of scene and view.
        scene: what is fitted: with its vertices where OpenGL rounds them to.
        compared: pyrender's image and ours, with the vertices as given and where they are rounded to.
        references: the latter, by renderer.
        fits: by renderer, and by what has a value of its own.
        band: pixels near an intersection, (H, W) bool.
        images: without merging, and by the antialiasing study's rule.
    """

    name: str
    scene: wf.Scene
    compared: dict[str, Comparison]
    references: dict[str, np.ndarray]
    fits: dict[str, dict[str, FitResult]]
    band: np.ndarray
    images: dict[str, np.ndarray]

    def psnr(self, image: np.ndarray, renderer: str) -> float:
        """Return the PSNR of an image in the band against a renderer's reference [dB]."""
        return psnr(image, self.references[renderer], self.band)

    def apart(self) -> list[float]:
        """Return how far what the fits found from the two references differs, relative."""
        pairs = [[fits[kind].found for fits in self.fits.values()] for kind in ("scene", "object")]
        return [abs(one[key] - other[key]) / max(abs(other[key]), SMALL) for one, other in pairs for key in one]


def main() -> None:
    """Compare, fit, draw, and write the README's numbers."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, help="width and height of the images (those of the scene files)")
    size = parser.parse_args().size
    factor = json.loads((ANTIALIASING / "numbers.json").read_text())["factor"]
    (HERE / "figures").mkdir(exist_ok=True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    try:
        cases = [case_of(name, scene, factor) for name, scene in scenes(size).items()]
    except NoOpenGLError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    first = cases[0]
    if size is None:
        # What study.toml fits to; of another size it would not fit its scene.
        write_image(HERE / "reference.png", first.compared[GIVEN].theirs.astype(np.float32), bits=16)
    np.savez_compressed(RESULTS / "references.npz", **first.references)
    curves = figures.by_thickness(first.scene, first.references, first.band)
    figures.comparison(first.compared, curves).savefig(HERE / "figures" / "comparison.png", dpi=150)
    summarise(cases, factor).save(HERE)


def scenes(size: int | None) -> dict[str, wf.Scene]:
    """Return the scenes by name, with images of a size."""
    spheres, cylinders = (wf.load_scene(HERE / f"{name}.toml") for name in ("cube_and_sphere", "cylinders"))
    another = replace(spheres, camera=replace(spheres.camera, eye=OTHER_EYE))
    found = {"cube and sphere": spheres, "another view": another, "cylinders": cylinders}
    if size is None:
        return found
    return {name: replace(scene, camera=scene.camera.resized((size, size))) for name, scene in found.items()}


def case_of(name: str, scene: wf.Scene, factor: float) -> Case:
    """Render a scene by both, and fit it to either image."""
    snapped = on_grid(scene, SAMPLES)
    compared = {GIVEN: compare(scene, SAMPLES), SNAPPED: compare(snapped, SAMPLES)}
    pair = compared[SNAPPED]
    references = {"pyrender": pair.theirs.astype(np.float32), "ours": pair.ours.astype(np.float32)}
    fits = {renderer: fit_all(snapped, image) for renderer, image in references.items()}
    images = {"none": wf.render(snapped, merge="none"), "rule": by_rule(snapped, factor)}
    print(f"{name}: compared and fitted", flush=True)
    return Case(name, snapped, compared, references, fits, intersection_band(snapped, SAMPLES)[1], images)


def fit_all(scene: wf.Scene, image: np.ndarray) -> dict[str, FitResult]:
    """Fit beta and one thickness, one for each object, and a map for each."""
    names = [f"{item.name}.thickness" for item in scene.objects]
    reference, beta = Reference(image=image), {"beta": BETA}
    maps = dict.fromkeys(names, FitParameter(THICKNESS, per="pixel"))
    options: dict[str, Any] = {"method": "adam", "steps": STEPS, "learning_rate": LEARNING_RATE, "tolerance": 0.0}
    return {
        "scene": wf.fit(Study(scene, reference, {**beta, "thickness": THICKNESS})),
        "object": wf.fit(Study(scene, reference, {**beta, **dict.fromkeys(names, THICKNESS)})),
        "pixel": wf.fit(Study(scene, reference, {**beta, **maps}, **options)),
    }


def by_rule(scene: wf.Scene, factor: float) -> np.ndarray:
    """Return the image whose thickness is what the antialiasing study's rule says."""
    fragments = wf.capture(scene).numpy()
    pairs = nearest_pairs(scene, fragments)
    thickness = np.where(pairs.distance <= REACH, factor * pairs.footprints()["|g₁ − g₂|"], 0.0)[fragments.pixel]
    image = wf.composite(replace(fragments, thickness=thickness.astype(np.float32)), 1.0, max_layers=scene.layers)
    return over_background(image, scene.background)


def summarise(cases: list[Case], factor: float) -> Summary:
    """Put the numbers into words and tables."""
    outside = max(255.0 * case.compared[SNAPPED].residual[~case.compared[SNAPPED].crossing].max() for case in cases)
    given = [case.compared[GIVEN] for case in cases]
    moved = sum(int((255.0 * pair.residual[~pair.crossing] > 1.0).sum()) for pair in given)
    differing = sum(int(pair.differing.sum()) for pair in given)
    total = sum(pair.crossing.size * SAMPLES**2 for pair in given)
    apart = max(value for case in cases for value in case.apart())
    answer = (
        f"From the same sample positions {differing:,} of {total:,} samples differ: OpenGL rounds projected vertices "
        f"to 1/256 of a sample. One sample of 64 is up to 4/255, so {moved} pixels outside intersections differ by "
        f"more than 1/255. With the vertices on that grid for both renderers the residual outside intersections is "
        f"{outside:.4f}/255 at most. Fits to pyrender's images and to ours then find the same β and thickness, to "
        f"{100.0 * apart:.2g} %."
    )
    first = cases[0]
    numbers = {
        "residual outside intersections [1/255]": outside,
        "samples that differ": differing,
        "thickness, pyrender": first.fits["pyrender"]["scene"].found["thickness"],
        "thickness, ours": first.fits["ours"]["scene"].found["thickness"],
        "rule, pyrender [dB]": first.psnr(first.images["rule"], "pyrender"),
    }
    where = ("samples that differ", "largest residual", "pixels over 1/255")
    head = ("vertices", *(f"{words}, outside" for words in where), *(f"{words}, at intersections" for words in where))
    rows = [(f"{c.name}, {name}", *residuals(pair)) for c in cases for name, pair in c.compared.items()]
    return Summary(
        name="opengl",
        title="Antialiased intersections against OpenGL",
        question="Is the reference of 64 samples the same from a renderer that is not ours, and are the fits to it?",
        answer=answer,
        tables=(
            Table(head, tuple(rows), "pyrender against ours, residuals in 1/255:"),
            *(fits_table(case, factor, further=case is not first) for case in cases),
        ),
        figures=(Figure("figures/comparison.png", "Where pyrender and ours differ, and PSNR against either."),),
        numbers=numbers,
        command="uv run python experiments/fit/opengl/study.py",
    )


def residuals(pair: Comparison) -> list[str | int]:
    """Word how far two images differ, outside intersections and at them."""
    cells: list[str | int] = []
    for mask in (~pair.crossing, pair.crossing):
        residual = 255.0 * pair.residual[mask]
        worst = residual.max()
        cells += [int(pair.differing[mask].sum()), f"{worst:.4f}" if worst < 1.0 else f"{worst:.1f}"]
        cells.append(int((residual > 1.0).sum()))
    return cells


def fits_table(case: Case, factor: float, further: bool) -> Table:
    """Return what was found from either reference, and how near it comes."""
    rows = []
    for name, image in case.images.items():
        words = "no merging" if name == "none" else f"rule, t = {factor:.2f}·|g₁ − g₂|"
        rows.append((words, "–", "–", *(f"{case.psnr(image, r):.2f}" for r in case.references)))
    for kind, words in KINDS.items():
        cells, levels = [], []
        for renderer, fits in case.fits.items():
            found = fits[kind].found
            thick = [f"{value:.5f}" for key, value in found.items() if key != "beta"] if kind != "pixel" else ["map"]
            cells.append(f"{' / '.join(thick)}, β {found['beta']:.3f}")
            levels.append(f"{case.psnr(fits[kind].after, renderer):.2f}")
        rows.append((words, *cells, *levels))
    caption = (
        f"{case.name[0].upper()}{case.name[1:]}: one sample a pixel, fitted to 64 by either renderer, thickness [scene "
        "units] and β; PSNR [dB] in the band around intersections against the reference fitted to:"
    )
    columns = ("", "found from pyrender", "found from ours", "PSNR, pyrender", "PSNR, ours")
    return Table(columns, tuple(rows), caption, further)


if __name__ == "__main__":
    main()
