"""Antialiased intersections against a renderer that is not ours: is pyrender's image ours, and are the fits the same?

Data goes to results/fit/opengl, pictures to figures/, the reference image to reference.png, the numbers to README.md.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
from comparison import Comparison, NoOpenGLError, compare, on_grid  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitParameter, FitResult, Reference, Study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.fit.summary import Figure, Summary, Table  # noqa: E402
from warpfrag.images import write_image  # noqa: E402

HERE = Path(__file__).parent
ANTIALIASING = HERE.parent / "antialiasing"
sys.path.append(str(ANTIALIASING))

from footprint import intersection_band, nearest_pairs, pixel_of  # noqa: E402

RESULTS = Path("results") / "fit" / "opengl"
SAMPLES = 8
BETA, THICKNESS = 0.9, 0.05
# Maps by Adam: steps, its rate.
STEPS, LEARNING_RATE = 150, 0.05
# The rule of the antialiasing study holds this far from an intersection [pixels].
REACH = 2.0
KINDS = {"scene": "global", "object": "per object", "pixel": "per pixel"}


def main() -> None:
    """Compare, fit, draw, and write the README's numbers."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, help="width and height of the images (those of the scene file)")
    size = parser.parse_args().size
    given = wf.load_scene(HERE / "cube_and_sphere.toml")
    scene = given if size is None else replace(given, camera=given.camera.resized((size, size)))
    try:
        compared = {"as given": compare(scene, SAMPLES), "on OpenGL's grid": compare(on_grid(scene, SAMPLES), SAMPLES)}
    except NoOpenGLError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (HERE / "figures").mkdir(exist_ok=True)
    pair = compared["as given"]
    references = {"pyrender": pair.theirs.astype(np.float32), "ours": pair.ours.astype(np.float32)}
    if scene.camera == given.camera:
        # What study.toml fits to; of another size it would not fit its scene.
        write_image(HERE / "reference.png", references["pyrender"], bits=16)
    np.savez_compressed(RESULTS / "references.npz", **references)
    fits = {name: fit_all(scene, image) for name, image in references.items()}
    band = intersection_band(scene, SAMPLES)[1]
    factor = json.loads((ANTIALIASING / "numbers.json").read_text())["factor"]
    images = {"none": wf.render(scene, merge="none"), "rule": by_rule(scene, factor)}
    curves = figures.by_thickness(scene, references, band)
    figures.comparison(compared, curves).savefig(HERE / "figures" / "comparison.png", dpi=150)
    summarise(compared, references, fits, images, band, factor).save(HERE)


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
    thickness = np.where(pairs.distance <= REACH, factor * pairs.footprints()["|g₁ − g₂|"], 0.0)[pixel_of(fragments)]
    image = wf.composite(replace(fragments, thickness=thickness.astype(np.float32)), 1.0, max_layers=scene.layers)
    return image + (1.0 - image[..., 3:]) * np.asarray(scene.background, np.float32)


def summarise(
    compared: dict[str, Comparison],
    references: dict[str, np.ndarray],
    fits: dict[str, dict[str, FitResult]],
    images: dict[str, np.ndarray],
    band: np.ndarray,
    factor: float,
) -> Summary:
    """Put the numbers into words and tables."""
    rows = []
    for name, pair in compared.items():
        residual, outside = 255.0 * pair.residual, ~pair.crossing
        cells = []
        for mask in (outside, pair.crossing):
            worst, over = residual[mask].max(), int((residual[mask] > 1.0).sum())
            cells += [int(pair.differing[mask].sum()), f"{worst:.4f}" if worst < 1.0 else f"{worst:.1f}", over]
        rows.append((name, *cells))
    levels = []
    for name, image in images.items():
        words = "no merging" if name == "none" else f"rule, t = {factor:.2f}·|g₁ − g₂|"
        levels.append((words, "–", "–", *(f"{psnr(image, references[r], band):.2f}" for r in references)))
    apart = []
    for kind, words in KINDS.items():
        one, other = (fits[name][kind] for name in references)
        values = [fit.found["beta"] for fit in (one, other)]
        if kind != "pixel":
            keys = [key for key in one.found if key != "beta"]
            thick = [" / ".join(f"{fit.found[key]:.5f}" for key in keys) for fit in (one, other)]
            apart += [abs(one.found[key] / other.found[key] - 1.0) for key in one.found]
        else:
            thick = ["map", "map"]
        cells = [f"{psnr(fits[name][kind].after, references[name], band):.2f}" for name in references]
        levels.append((words, *(f"{t}, β {b:.3f}" for t, b in zip(thick, values, strict=True)), *cells))
    pair, snapped = compared.values()
    outside = 255.0 * snapped.residual[~snapped.crossing].max()
    moved = int((255.0 * pair.residual[~pair.crossing] > 1.0).sum())
    size, total = pair.crossing.shape, pair.crossing.size * SAMPLES**2
    answer = (
        f"From the same sample positions {int(pair.differing.sum())} of {total:,} samples differ: OpenGL rounds "
        f"projected vertices to 1/256 of a sample. One sample of 64 is up to 4/255, so {moved} pixels outside "
        f"intersections differ by more than 1/255. With the vertices on that grid for both renderers the residual "
        f"outside intersections is {outside:.4f}/255 at most. Fits to pyrender's image and to ours find the same β and "
        f"thickness, to {100.0 * max(apart):.2g} %."
    )
    numbers = {
        "residual outside intersections [1/255]": outside,
        "samples that differ": int(pair.differing.sum()),
        "thickness, pyrender": fits["pyrender"]["scene"].found["thickness"],
        "thickness, ours": fits["ours"]["scene"].found["thickness"],
        "rule, pyrender [dB]": psnr(images["rule"], references["pyrender"], band),
    }
    where = ("samples that differ", "largest residual", "pixels over 1/255")
    head = ("vertices", *(f"{words}, outside" for words in where), *(f"{words}, at intersections" for words in where))
    return Summary(
        name="opengl",
        title="Antialiased intersections against OpenGL",
        question="Is the reference of 64 samples the same from a renderer that is not ours, and are the fits to it?",
        answer=answer,
        tables=(
            Table(head, tuple(rows), f"pyrender against ours, {size[1]} × {size[0]} pixels, residuals in 1/255:"),
            Table(
                ("", "found from pyrender", "found from ours", "PSNR, pyrender", "PSNR, ours"),
                tuple(levels),
                "One sample a pixel, fitted to 64 by either renderer: thickness [scene units], β, and PSNR [dB] in the "
                "band around intersections against the reference fitted to:",
            ),
        ),
        figures=(Figure("figures/comparison.png", "Where pyrender and ours differ, and PSNR against either."),),
        numbers=numbers,
        command="uv run python experiments/fit/opengl/study.py",
    )


if __name__ == "__main__":
    main()
