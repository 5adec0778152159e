"""How thick slabs must be for a few merged layers to stand for all fragments: by hand, fitted, by rule.

Fits `study.toml` and its like, measures, draws `figures/` and writes the numbers of README.md.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
import torch  # noqa: E402
from budget import METHODS, Case, psnr  # noqa: E402
from deep_scenes import assembly, floor, hair_ball  # noqa: E402
from maps import BLOCK, FACTORS, RULES, Search, by_rule, descend  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitResult, Reference, load_study  # noqa: E402
from warpfrag.fit.summary import Figure, Summary, Table  # noqa: E402
from warpfrag.saving import replacing  # noqa: E402

HERE = Path(__file__).parent
RESULTS = Path("results") / "fit" / "layer_budgets"
BUDGETS = (2, 4, 8)
# What there is something to choose for. Without a surface inserted, methods that sort want no thickness at all.
OPEN = tuple((method, "inserted") for method in METHODS) + (("SKB+OFM", "image"),)
MERGES = {"SFM": "smooth", "exact": "exact", "SKB+OFM": "order_independent"}
STEPS = 60
Key = tuple[str, str, int]


@dataclass(eq=False)
class Measured:
    """What was found for a scene.

    Attributes:
        case: the scene.
        choices: thickness by way of choosing it, by (method, measure, M): a map, or a number in multiples of P(z).
        scores: see `Case.scores`, by (method, measure, M) and way.
        one: best single value [shares of the scene's depth].
        rules: root mean square error by factor, by rule, (factors,).
        moved: share of the pixels whose first gradient is not 0.
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
    report(measured, factors)


def measure(case: Case) -> Measured:
    """Search a scene's thicknesses, and measure what the paper takes."""
    found = Measured(case)
    for method in METHODS:
        for layer_count in BUDGETS:
            search = Search.run(case, method, layer_count)
            for measure in ("image", "inserted"):
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
                for measure in ("image", "inserted"):
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
        own = by_rule(case, key[2], found.factor(RULES[0]))
        found.score(key, "own factor", own)


def by_gradient(found: Measured) -> None:
    """Fit maps by gradient: of the image with the package, from 100 P(z); with a surface inserted from the best value."""
    case = found.case
    depth = case.span[1] - case.span[0]
    for method in METHODS:
        for layer_count in BUDGETS:
            result = fit_image(case, method, layer_count)
            change = np.asarray(result.found["thickness"]).reshape(-1) != np.asarray(result.start["thickness"]).reshape(
                -1
            )
            key = method, "image", layer_count
            found.moved[key] = float(change[case.covered].mean())
            after = torch.as_tensor(result.after[..., :3].reshape(-1, 1, 3))
            found.scores[key]["gradient"] = case.score(after - case.reference[:, -1:])
            key = method, "inserted", layer_count
            descent = descend(case, method, layer_count, found.one[key] * depth, STEPS)
            found.moved[key] = descent.moved
            found.score(key, "gradient", descent.thickness)
        print(f"{case.name}: {method} fitted", flush=True)


def fit_image(case: Case, method: str, layer_count: int) -> FitResult:
    """Fit one thickness a pixel to the image of all fragments, as study.toml does for SFM and four layers."""
    study = load_study(HERE / "study.toml", size=case.scene.camera.size)
    image = case.reference[:, -1].reshape(*case.scene.camera.shape, 3).numpy()
    scene: Any = replace(study.scene, layers=layer_count, merge=MERGES[method])
    resolve: Any = "kbuffer" if method == "SKB+OFM" else "sorted"
    # A loss that no step changes needs no sixty of them.
    return wf.fit(replace(study, scene=scene, resolve=resolve, reference=Reference(image), patience=10))


def report(measured: list[Measured], factors: dict[str, float]) -> None:
    """Write the results' data, and the README's numbers."""
    fitted, others = measured[0], measured[1:]
    RESULTS.mkdir(parents=True, exist_ok=True)
    with replacing(RESULTS / "scores.json") as partial:
        rows = {one.case.name: {" ".join(map(str, key)): ways for key, ways in one.scores.items()} for one in measured}
        partial.write_text(json.dumps(rows, indent=1))
    numbers = {"factor": factors[RULES[0]]}
    for one in measured:
        for way in ("100P", "one value", RULES[0], "blocks", "pixels"):
            numbers[f"{one.case.name}: {way} [dB]"] = one.mean_psnr(way)
    for key in (("SFM", "inserted", 4), ("SKB+OFM", "image", 4), ("SKB+OFM", "inserted", 4)):
        for way in ("2P", "100P", "one value", RULES[0], "pixels"):
            numbers[f"{key[0]}, {key[1]}, M = {key[2]}: {way} [rms]"] = fitted.scores[key][way]["rms"]
    Summary(
        name="layer_budgets",
        title="Layer budgets",
        question="Which z-thickness makes 2, 4 or 8 merged layers stand for all fragments?",
        answer=answer(measured),
        tables=(by_budget(fitted), absolute(fitted), by_scene(measured, factors)),
        figures=(
            Figure("figures/errors.png", "Error against the number of layers, by scene and method."),
            Figure("figures/images.png", "The machine in four layers, and errors."),
            Figure("figures/maps.png", "Complexity of the pixels, and thickness maps for SFM with four layers."),
        ),
        numbers=numbers,
        command="uv run python experiments/fit/layer_budgets/study.py",
    ).save(HERE)


WAYS = {
    "2P": "2P",
    "100P": "100P",
    "one value": "one value, fitted",
    "gradient": "map, by gradient",
    RULES[0]: "rule",
    "blocks": f"map, {BLOCK}² blocks",
    "pixels": "best possible per pixel",
}


def answer(measured: list[Measured]) -> str:
    """Return the study's answer in words."""
    fitted = measured[0]

    def image(method: str, way: str) -> str:
        values = [fitted.scores[method, "image", count][way]["rms"] for count in BUDGETS]
        return f"{min(values):.2g} … {max(values):.2g}"

    kept = [one.mean_psnr(RULES[0]) - one.mean_psnr("100P") for one in measured]
    most = [one.mean_psnr("pixels") - one.mean_psnr("100P") for one in measured]
    shares = " / ".join(f"{100.0 * part / whole:.0f} %" for part, whole in zip(kept, most, strict=True))
    gains = " / ".join(f"{part:.1f}" for part in kept)
    names = " / ".join(one.case.name for one in measured)
    return (
        f"For the image alone SFM and exact merging want no thickness at all: at 100P the error is {image('SFM', '100P')} "
        f"and {image('exact', '100P')} levels of 255, at t = 0 it is 0 for every M, since what is too much goes to the tail by over. "
        f"SKB+OFM, and all methods once a surface is inserted among the layers, want more than 100P where there are more fragments than "
        f"layers. Against 100P the best thickness of each pixel gains {' / '.join(f'{value:.1f}' for value in most)} dB "
        f"({names}; mean of methods and M), the rule by complexity, its one factor fitted on the machine, {gains} dB: "
        f"{shares} of it."
    )


def by_budget(found: Measured) -> Table:
    """Return the PSNR of the fitted scene by method, measure, number of layers and way of choosing."""
    rows = []
    for method in METHODS:
        for measure in ("image", "inserted"):
            for layer_count in BUDGETS:
                scores = found.scores[method, measure, layer_count]
                cells = [_decibels(scores[way]["rms"]) for way in WAYS]
                rows.append((method, measure, layer_count, *cells))
    caption = "PSNR [dB] of the machine, the image and with a surface inserted, against the sorted A-buffer."
    return Table(("method", "measure", "M", *WAYS.values()), tuple(rows), caption)


def absolute(found: Measured) -> Table:
    """Return mean and 99th percentile of the absolute error of the fitted scene."""
    rows = []
    for method, measure in OPEN:
        for layer_count in BUDGETS:
            scores = found.scores[method, measure, layer_count]
            cells = [f"{scores[way]['mean']:.2f}, {scores[way]['p99']:.1f}" for way in WAYS]
            rows.append((method, measure, layer_count, *cells))
    caption = "Mean and 99th percentile of the absolute error [levels of 255, linear light]."
    return Table(("method", "measure", "M", *WAYS.values()), tuple(rows), caption)


def by_scene(measured: list[Measured], factors: dict[str, float]) -> Table:
    """Return the mean PSNR of every scene by what its thickness was fitted to."""
    columns = {
        "2P": "2P",
        "100P": "100P",
        "one value carried over": "one value, the machine's",
        RULES[1]: f"{factors[RULES[1]]:.2f} {RULES[1]}",
        RULES[0]: f"{factors[RULES[0]]:.2f} {RULES[0]}",
        "one value": "one value of its own",
        "own factor": f"{RULES[0]}, own factor",
        "blocks": WAYS["blocks"],
        "pixels": WAYS["pixels"],
    }
    rows = []
    for one in measured:
        counts = one.case.counts[one.case.covered]
        cells: list[Any] = [f"{one.mean_psnr(way):.1f}" for way in columns]
        cells[6] += f" ({one.factor(RULES[0]):.2f})"
        rows.append((one.case.name, f"{counts.mean():.0f}, {counts.max()}", *cells))
    caption = "Mean PSNR [dB] of the twelve rows of the table before, by scene."
    return Table(("scene", "fragments a pixel: mean, most", *columns.values()), tuple(rows), caption)


def _decibels(rms: float) -> str:
    # What float32 rounds is no error of the method.
    return f"{psnr(rms):.1f}" if psnr(rms) < 100.0 else "> 100"


if __name__ == "__main__":
    main()
