"""How thick slabs must be for a few merged layers to stand for all fragments: by hand, fitted, by rule.

Fits `study.toml` and its like, measures, draws `figures/` and writes the numbers of README.md.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
import report  # noqa: E402
import torch  # noqa: E402
from budget import BUDGETS, MEASURES, METHODS, OPEN, Case, Key, psnr  # noqa: E402
from deep_scenes import assembly, floor, hair_ball  # noqa: E402
from maps import FACTORS, RULES, Search, by_rule, descend  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitResult, Reference, load_study  # noqa: E402

HERE = Path(__file__).parent
MERGES = {"SFM": "smooth", "exact": "exact", "SKB+OFM": "order_independent"}
STEPS = 60


@dataclass(eq=False)
class Measured:
    """What was found for a scene.

    Attributes:
        case: the scene.
        choices: thickness by way of choosing it, by (method, measure, M): a map, or a number in multiples of P(z).
        scores: see `Case.scores`, by (method, measure, M) and way.
        one: best single value [shares of the scene's depth].
        rules: root mean square error by factor, by rule, (factors,).
        moved: share of the pixels that the gradient moves.
    """

    case: Case
    choices: dict[Key, dict[str, Any]] = field(default_factory=dict)
    scores: dict[Key, dict[str, dict[str, float]]] = field(default_factory=dict)
    one: dict[Key, float] = field(default_factory=dict)
    rules: dict[str, dict[Key, np.ndarray]] = field(default_factory=lambda: {rule: {} for rule in RULES})
    moved: dict[Key, float] = field(default_factory=dict)

    def keys(self) -> Iterator[Key]:
        """Yield what there is something to choose for."""
        for method, measure in OPEN:
            for layer_count in BUDGETS:
                yield method, measure, layer_count

    def mean_psnr(self, way: str) -> float:
        """Return the mean PSNR of a way of choosing, over methods, measures and budgets [dB]."""
        return float(np.mean([psnr(self.scores[key][way]["rms"]) for key in self.keys()]))

    def factor(self, rule: str) -> float:
        """Return the one factor of a rule that is best for all methods, measures and budgets together."""
        logarithms = np.log([self.rules[rule][key] for key in self.keys()])
        return float(FACTORS[logarithms.mean(axis=0).argmin()])

    def factors(self, rule: str, layer_count: int) -> tuple[float, float]:
        """Return the least and the largest factor that is best for one method and measure."""
        best = [FACTORS[self.rules[rule][key].argmin()] for key in self.keys() if key[2] == layer_count]
        return float(min(best)), float(max(best))

    def lost(self, rule: str, factor: float, layer_count: int) -> float:
        """Return the most that a factor loses against the best one of a method and measure [dB]."""
        place = int(np.abs(FACTORS - factor).argmin())
        rows = [self.rules[rule][key] for key in self.keys() if key[2] == layer_count]
        return max(psnr(errors.min()) - psnr(errors[place]) for errors in rows)

    def multiple(self, key: Key) -> float:
        """Return the best single value in multiples of the mean P(z)."""
        return self.one[key] * (self.case.span[1] - self.case.span[0]) / self.case.resolution

    def score(self, key: Key, way: str, thickness: Any) -> None:
        """Measure a choice."""
        method, measure, layer_count = key
        self.choices.setdefault(key, {})[way] = thickness
        self.scores.setdefault(key, {})[way] = self.case.scores(method, layer_count, thickness)[measure]


def main() -> None:
    """Measure everything, draw it and write it down."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, default=128, help="width and height of the images [pixels]")
    size = parser.parse_args().size
    # Its operations are too small here to be worth sharing.
    torch.set_num_threads(1)
    cases = [
        Case(name, make(size)) for name, make in (("machine", assembly), ("hair ball", hair_ball), ("floor", floor))
    ]
    measured = [measure(case) for case in cases]
    fitted = measured[0]
    factors = {rule: fitted.factor(rule) for rule in RULES}
    for one in measured:
        carry_over(one, fitted, factors)
    by_gradient(fitted)
    folder = HERE / "figures"
    folder.mkdir(exist_ok=True)
    figures.errors(measured, BUDGETS).savefig(folder / "errors.png", dpi=130)
    figures.images(fitted).savefig(folder / "images.png", dpi=130)
    figures.maps(fitted).savefig(folder / "maps.png", dpi=130)
    report.save(measured, factors)


def measure(case: Case) -> Measured:
    """Search a scene's thicknesses, and measure what the paper takes."""
    found = Measured(case)
    for method in METHODS:
        for layer_count in BUDGETS:
            search = Search.run(case, method, layer_count)
            for measure in MEASURES:
                key = method, measure, layer_count
                for way, multiple in (("2P", 2.0), ("100P", 100.0)):
                    found.score(key, way, multiple)
                value = search.one(measure)
                found.one[key] = value / (case.span[1] - case.span[0])
                found.score(key, "one value", np.full(len(case.counts), value))
                found.score(key, "blocks", search.blocks(measure))
                found.score(key, "pixels", search.pixels(measure))
            for rule, rows in found.rules.items():
                tried = [case.squares(method, layer_count, by_rule(case, layer_count, f, rule)) for f in FACTORS]
                for measure in MEASURES:
                    rows[method, measure, layer_count] = np.array([case.rms(squares[measure]) for squares in tried])
        print(f"{case.name}: {method} searched", flush=True)
    return found


def carry_over(found: Measured, fitted: Measured, factors: dict[str, float]) -> None:
    """Measure the rules with the factors of the fitted scene, and its best single values, on a scene."""
    case = found.case
    for key in fitted.one:
        value = fitted.one[key] * (case.span[1] - case.span[0])
        found.score(key, "one value carried over", np.full(len(case.counts), value))
        for rule, factor in factors.items():
            found.score(key, rule, by_rule(case, key[2], factor, rule))
        found.score(key, "own factor", by_rule(case, key[2], found.factor(RULES[0])))


def by_gradient(found: Measured) -> None:
    """Fit maps by gradient: to the image from 100 P(z), with a surface inserted from the best value if thicker."""
    case = found.case
    depth, thin = case.span[1] - case.span[0], 100.0 * case.resolution
    for method in METHODS:
        for layer_count in BUDGETS:
            key = method, "image", layer_count
            result = fit_image(case, method, layer_count)
            # The logarithm and back leave rounding behind.
            changed = ~np.isclose(result.found["thickness"], result.start["thickness"], rtol=1e-6).reshape(-1)
            found.moved[key] = float(changed[case.covered].mean())
            after = torch.as_tensor(result.after[..., :3].reshape(-1, 1, 3))
            found.scores[key]["together"] = case.score(after - case.reference[:, -1:])
            key = method, "inserted", layer_count
            descent = descend(case, method, layer_count, max(found.one[key] * depth, thin), STEPS)
            found.moved[key] = descent.moved
            found.score(key, "together", descent.together)
            found.score(key, "on the way", descent.pixels)
        print(f"{case.name}: {method} fitted", flush=True)


def fit_image(case: Case, method: str, layer_count: int) -> FitResult:
    """Fit one thickness a pixel to the image of all fragments, as study.toml does for SFM and four layers."""
    study = load_study(HERE / "study.toml", size=case.scene.camera.size)
    image = case.reference[:, -1].reshape(*case.scene.camera.shape, 3).numpy()
    merge: Any = MERGES[method]
    scene = replace(study.scene, layers=layer_count, merge=merge)
    resolve: Any = "kbuffer" if method == "SKB+OFM" else "sorted"
    # A loss that no step changes needs no sixty of them.
    return wf.fit(replace(study, scene=scene, resolve=resolve, reference=Reference(image), patience=10))


if __name__ == "__main__":
    main()
