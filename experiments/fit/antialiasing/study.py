"""Antialiased intersections: which thickness makes one sample a pixel look like 64, and what it follows from.

Data goes to results/fit/antialiasing, pictures to figures/, the numbers to README.md.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
from footprint import intersection_band, nearest_pairs, slopes_of  # noqa: E402
from scipy.optimize import minimize_scalar  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitParameter, FitResult, Reference, Study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.samples import over_background  # noqa: E402
from warpfrag.studies.summary import Figure, Summary, Table  # noqa: E402

HERE = Path(__file__).parent
RESULTS = Path("results") / "fit" / "antialiasing"
COMMAND = "uv run python experiments/fit/antialiasing/study.py"
# Samples along each edge of a pixel of the reference.
SAMPLES = 8
OPACITIES = (1.0, 0.6)
OTHER_EYE = (-2.2, 2.4, 2.1)
RULE = "|g₁ − g₂|"
OWN = "|g₁|, |g₂|: each its own"
METHODS = {
    "none": "no merging",
    "2P": "t = 2·P(z)",
    "hand-set": "0.02 × height",
    "pixel size": "pixel size",
    "global": "fitted, global",
    "per object": "fitted, per object",
    "rule": "rule",
    "per pixel": "fitted, per pixel",
}
BETAS = (0.0, 0.5, 1.0)
# Where fits start: the better of two ends counts, as there is a minimum at either end of beta. In pixel sizes, and
# thick, as there is no gradient where slabs do not overlap.
START_BETAS, START_THICKNESS = (0.9, 0.1), 3.0
STEPS, LEARNING_RATE = 150, 0.05
# A rule sets the thickness where the planes of two surfaces cross within this distance [pixels], elsewhere it is 0.
REACH = 2.0
# Thicknesses tried in each pixel, in pixel sizes.
TRIED = np.geomspace(0.03, 60.0, 153)
# A pixel tells its best thickness if without merging it is off by more than the first, with it by less than the second,
# and a quarter more or less thickness costs more than the third (root mean square over the channels).
WRONG, RIGHT, SENSITIVE = 8 / 255, 3 / 255, 1 / 255


@dataclass(eq=False)
class Case:
    """A scene at one opacity from one view, and all that is measured there.

    Attributes:
        name: the view.
        opacity: of both objects.
        scene: what is rendered, at one sample a pixel.
        fitted: whether the rule's constant is found here; elsewhere it is carried over.
        fragments: those of the scene, sorted.
        crossing: pixels that a curve of intersection passes through, (H, W) bool.
        band: those near it, (H, W) bool.
        pixel_size: by pixel, at the depth of the two surfaces that cross nearest by [scene units], (P,).
        footprints: what the best thickness may be a multiple of, by name: one for both of those surfaces, (P,).
        units: thickness of each fragment by these rules at a factor of 1, and by that of its own slope, (F,).
        fits: by what has a value of its own: "scene", "object", "pixel".
        images: by method.
    """

    name: str
    opacity: float
    scene: wf.Scene
    fitted: bool
    fragments: wf.Fragments = field(init=False)
    crossing: np.ndarray = field(init=False)
    band: np.ndarray = field(init=False)
    pixel_size: np.ndarray = field(init=False)
    footprints: dict[str, np.ndarray] = field(init=False)
    units: dict[str, np.ndarray] = field(init=False)
    fits: dict[str, FitResult] = field(init=False)
    images: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.scene.objects = [replace(item, opacity=self.opacity) for item in self.scene.objects]
        self.fragments = wf.capture(self.scene).numpy()
        self.crossing, self.band = intersection_band(self.scene, SAMPLES)
        pairs = nearest_pairs(self.scene, self.fragments)
        self.pixel_size, self.footprints = pairs.pixel_size, pairs.footprints()
        pixel, slopes = self.fragments.pixel, slopes_of(self.scene, self.fragments)[0]
        near = (pairs.distance <= REACH)[pixel]
        self.units = {name: np.where(near, each[pixel], 0.0) for name, each in self.footprints.items()}
        self.units[OWN] = np.where(near, np.linalg.norm(slopes, axis=1), 0.0)
        self.fits = fit_all(self.scene, START_THICKNESS * float(np.median(self.pixel_size[self.crossing.reshape(-1)])))

    @property
    def title(self) -> str:
        """View and opacity in words."""
        return f"{self.name}, A = {self.opacity:g}"

    @property
    def reference(self) -> np.ndarray:
        """The image of 64 samples a pixel."""
        return self.fits["scene"].reference

    def image(self, thickness: Any, beta: float = 1.0) -> np.ndarray:
        """Return the image with one thickness for all fragments, or one for each (F,)."""
        each = np.broadcast_to(np.asarray(thickness, np.float32), self.fragments.depth.shape)
        slabs = replace(self.fragments, thickness=np.ascontiguousarray(each))
        image = wf.composite(slabs, beta, max_layers=self.scene.layers, merge="smooth")
        return over_background(image, self.scene.background)

    def error(self, image: np.ndarray) -> np.ndarray:
        """Return the mean squared difference from the reference over the channels of colour, (H, W)."""
        return np.square(image[..., :3] - self.reference[..., :3], dtype=np.float64).mean(axis=-1)

    def psnr(self, image: np.ndarray, mask: np.ndarray | None = None) -> float:
        """Return the peak signal-to-noise ratio in linear light, of all pixels or of some [dB]."""
        return psnr(image, self.reference, mask)

    def by_rule(self, rule: str, factor: float, beta: float = 1.0) -> np.ndarray:
        """Return the image whose thickness is a multiple of a footprint."""
        return self.image(factor * self.units[rule], beta)


def main() -> None:
    """Measure, draw, and write the README's numbers."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, default=128, help="width and height of the images (128)")
    size = parser.parse_args().size
    RESULTS.mkdir(parents=True, exist_ok=True)
    (HERE / "figures").mkdir(exist_ok=True)
    all_cases = cases(size)
    factors = {name: best_factor([c for c in all_cases if c.fitted], name) for name in all_cases[0].units}
    for case in all_cases:
        render_all(case, factors)
    best = {case.title: best_thickness(case) for case in all_cases}
    np.savez_compressed(
        RESULTS / "best_thickness.npz", **{f"{t}/{k}": v for t, d in best.items() for k, v in d.items()}
    )
    figures.images(all_cases).savefig(HERE / "figures" / "images.png", dpi=150)
    figures.rule(all_cases, best, factors, RULE).savefig(HERE / "figures" / "rule.png", dpi=150)
    summarise(size, all_cases, factors, best).save(HERE)


def cases(size: int) -> list[Case]:
    """Return the cases: those to find the rule in, then those to carry it over to."""
    scene, cylinders = (wf.load_scene(HERE / f"{name}.toml") for name in ("cube_and_sphere", "cylinders"))
    views = {
        "cube and sphere": (scene, scene.camera, size),
        "another view": (scene, replace(scene.camera, eye=OTHER_EYE), size),
        "half the size": (scene, scene.camera, size // 2),
        "cylinders": (cylinders, cylinders.camera, size),
    }
    result = []
    for index, (name, (scene, camera, edge)) in enumerate(views.items()):
        for opacity in OPACITIES:
            sized = replace(scene, camera=camera.resized((edge, edge)))
            result.append(Case(name, opacity, sized, fitted=index == 0))
            print(f"{result[-1].title}: {result[-1].crossing.sum()} crossing pixels", flush=True)
    return result


def fit_all(scene: wf.Scene, thickness: float) -> dict[str, FitResult]:
    """Fit beta and one thickness, one for each object, and a map for each, to 64 samples a pixel."""
    names = [f"{item.name}.thickness" for item in scene.objects]
    reference = Reference(true={}, supersampling=SAMPLES, merge="none")
    results: dict[str, FitResult] = {}
    for kind, fitted in {"scene": ["thickness"], "object": names}.items():
        ends = []
        for beta in START_BETAS:
            ends.append(wf.fit(Study(scene, reference, {"beta": beta, **dict.fromkeys(fitted, thickness)})))
            reference = Reference(image=ends[0].reference)
        results[kind] = min(ends, key=lambda end: end.loss)
    maps = {name: FitParameter(thickness, per="pixel") for name in names}
    options: dict[str, Any] = {"method": "adam", "steps": STEPS, "learning_rate": LEARNING_RATE, "tolerance": 0.0}
    many = Study(scene, reference, {"beta": START_BETAS[0], **maps}, **options)
    return {**results, "pixel": wf.fit(many)}


def best_factor(some: Sequence[Case], footprint: str, beta: float = 1.0) -> float:
    """Return the multiple of a footprint with the highest mean PSNR in the band of some cases."""

    def loss(logarithm: float) -> float:
        factor = float(np.exp(logarithm))
        return -float(np.mean([case.psnr(case.by_rule(footprint, factor, beta), case.band) for case in some]))

    # From a grid first: towards thick slabs the curve has further maxima, low ones.
    grid = np.log(np.geomspace(0.1, 5.0, 21))
    start = int(np.clip(np.argmin([loss(value) for value in grid]), 1, len(grid) - 2))
    bounds = (grid[start - 1], grid[start + 1])
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return float(np.exp(found.x))


def render_all(case: Case, factors: dict[str, float]) -> None:
    """Render a case by every method."""
    scene = case.scene
    p = [replace(item, thickness=2.0, thickness_unit="P") for item in scene.objects]
    case.images = {
        "none": case.image(0.0),
        "2P": wf.render(replace(scene, objects=p)),
        "hand-set": wf.render(scene),
        "pixel size": case.image(case.pixel_size[case.fragments.pixel]),
        "global": case.fits["scene"].after,
        "per object": case.fits["object"].after,
        "rule": case.by_rule(RULE, factors[RULE]),
        "per pixel": case.fits["pixel"].after,
    }


def best_thickness(case: Case) -> dict[str, np.ndarray]:
    """Search each crossing pixel for its best thickness.

    Returns:
        "t" of those that tell it clearly, with their footprints by name; and in all "every ratio", t over the rule's.
    """
    tried, owner = TRIED[:, None] * case.pixel_size, case.fragments.pixel
    errors = np.stack([case.error(case.image(thickness[owner])).reshape(-1) for thickness in tried])
    best, pixel = errors.argmin(axis=0), np.arange(errors.shape[1])
    lowest = errors[best, pixel]
    quarter = round(np.log(1.25) / np.log(TRIED[1] / TRIED[0]))
    last = len(TRIED) - 1
    around = [errors[np.clip(best + step, 0, last), pixel] for step in (-quarter, quarter)]
    tells = case.crossing.reshape(-1) & (case.error(case.images["none"]).reshape(-1) > WRONG**2)
    tells &= (lowest < RIGHT**2) & (np.minimum(*around) > lowest + SENSITIVE**2)
    footprints = {name: values[tells] for name, values in case.footprints.items()}
    known = case.crossing.reshape(-1) & (case.footprints[RULE] > 0.0)
    ratios = tried[best, pixel][known] / case.footprints[RULE][known]
    return {"t": tried[best, pixel][tells], "every ratio": ratios, **footprints}


def summarise(size: int, all_cases: list[Case], factors: dict[str, float], best: dict[str, Any]) -> Summary:
    """Put the numbers into words and tables."""
    fitted, others = [c for c in all_cases if c.fitted], [c for c in all_cases if not c.fitted]

    def mean(some: Sequence[Case], image: Callable[[Case], np.ndarray]) -> float:
        return float(np.mean([case.psnr(image(case), case.band) for case in some]))

    def psnrs(mask: str | None, caption: str) -> Table:
        rows = tuple(
            (case.title, *(f"{case.psnr(case.images[m], getattr(case, mask) if mask else None):.1f}" for m in METHODS))
            for case in all_cases
        )
        return Table(("", *METHODS.values()), rows, caption, further=mask is None)

    candidates = []
    for name, factor in factors.items():
        at_home = [f"{mean(some, lambda c, n=name, f=factor: c.by_rule(n, f)):.1f}" for some in (fitted, others)]
        again = np.mean([case.psnr(case.by_rule(name, best_factor([case], name)), case.band) for case in others])
        low, middle, high = quartiles(best, name) if name in all_cases[0].footprints else (0.0, 0.0, 0.0)
        spread = f"{middle:.2f} ({low:.2f} … {high:.2f})" if middle else "–"
        candidates.append((name, f"{factor:.2f}", spread, *at_home, f"{again:.1f}"))
    found = []
    for case in all_cases:
        one, several = case.fits["scene"].found, case.fits["object"].found
        thick = [f"{several[f'{item.name}.thickness']:.4f}" for item in case.scene.objects]
        carried = next(c for c in all_cases if c.opacity == case.opacity).fits["scene"].found
        cells = (f"{one['beta']:.2f}", f"{one['thickness']:.4f}", f"{several['beta']:.2f}", " / ".join(thick))
        transfer = case.psnr(case.image(carried["thickness"], carried["beta"]), case.band)
        own = best_factor([case], RULE)
        found.append((case.title, *cells, f"{case.fits['pixel'].found['beta']:.2f}", f"{transfer:.1f}", f"{own:.2f}"))
    betas = []
    for beta in BETAS:
        own_factors = [best_factor([case], RULE, beta) for case in fitted]
        levels = [c.psnr(c.by_rule(RULE, f, beta), c.band) for c, f in zip(fitted, own_factors, strict=True)]
        betas.append((f"{beta:g}", *(f"{v:.1f} ({f:.2f})" for v, f in zip(levels, own_factors, strict=True))))
    shown = ("none", "pixel size", "global", "rule")
    none, pixel, fitted_there, rule = (mean(others, lambda c, m=m: c.images[m]) for m in shown)
    low, middle, high = quartiles(best, RULE)
    told = sum(len(data["t"]) for data in best.values())
    every = np.concatenate([data["every ratio"] for data in best.values()])
    everywhere = mean(others, lambda c: c.image(factors[RULE] * c.footprints[RULE][c.fragments.pixel]))
    answer = (
        f"t = {factors[RULE]:.2f}·|g₁ − g₂| for both surfaces, where g is the gradient of a surface's depth along the "
        f"ray from pixel to pixel: the length of the *difference* of the two footprints, neither the pixel size nor "
        f"either surface's own. In the {told:,} of {len(every):,} crossing pixels that tell their best thickness "
        f"clearly, t/|g₁ − g₂| has median {middle:.2f} and quartiles {low:.2f} and {high:.2f} (median of all: "
        f"{np.median(every):.2f}). Carried over to another view, resolution and scene, the rule reaches {rule:.1f} dB "
        f"in the band around intersections (mean of {len(others)} images; {everywhere:.1f} if it sets every pixel's "
        f"thickness), against {fitted_there:.1f} with one thickness fitted to each of them, {pixel:.1f} with the pixel "
        f"size and {none:.1f} unmerged."
    )
    numbers = {
        "factor": factors[RULE],
        "median ratio": middle,
        "carried over [dB]": rule,
        "global, fitted there [dB]": fitted_there,
        "pixel size [dB]": pixel,
        "none [dB]": none,
    }
    return Summary(
        name="antialiasing",
        title="Antialiased intersections",
        question="Which thickness makes an intersection at one sample a pixel look like 64, and what does it follow?",
        answer=answer,
        tables=(
            psnrs("band", f"PSNR [dB] in the band around intersections, {size}² pixels (half of it: {size // 2}²):"),
            psnrs(None, "PSNR [dB] of the whole image, silhouettes included:"),
            Table(
                ("t =", "factor", f"best t by pixel ({told}), quartiles", "PSNR, fitted", "carried over", "refitted"),
                tuple(candidates),
                "Multiples of a footprint. The factor is fitted in the first view (mean PSNR of the band, both "
                "opacities), carried over to the others, and fitted anew in each of them:",
            ),
            Table(
                ("", "β", "t", "β", "t per object", "β of maps", "first view's β, t: PSNR", "own factor"),
                tuple(found),
                "What the fits found, global, per object and per pixel [scene units]; how far the global fit of the "
                "first view carries over; and the rule's factor fitted to each image by itself:",
                further=True,
            ),
            Table(
                ("β", *(f"A = {case.opacity:g}" for case in fitted)),
                tuple(betas),
                "PSNR of the band [dB] by β, thickness by the rule with its best factor (in brackets), first view:",
                further=True,
            ),
        ),
        figures=(
            Figure("figures/images.png", "Crops of the first view by method, and eight times their errors."),
            Figure("figures/rule.png", "The best thickness of each pixel against footprints, and PSNR by factor."),
        ),
        numbers=numbers,
        command=COMMAND,
    )


def quartiles(best: dict[str, dict[str, np.ndarray]], name: str) -> np.ndarray:
    """Return the quartiles of best thickness over footprint, of the pixels of all cases."""
    ratios = np.concatenate([data["t"] / data[name] for data in best.values()])
    return np.quantile(ratios, (0.25, 0.5, 0.75))


if __name__ == "__main__":
    main()
