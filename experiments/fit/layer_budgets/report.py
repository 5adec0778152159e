"""Writes what study.py has measured: its data, and the answer and tables of README.md."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from budget import BUDGETS, METHODS, OPEN, psnr
from maps import BLOCK, RULES

from warpfrag.files.saving import replacing
from warpfrag.studies.summary import Figure, Summary, Table

HERE = Path(__file__).parent
RESULTS = Path("results") / "fit" / "layer_budgets"
WAYS = {
    "2P": "2P",
    "100P": "100P",
    "one value": "one value, fitted",
    "together": "map, by gradient",
    RULES[0]: "rule",
    "blocks": f"map, {BLOCK}² blocks",
    "on the way": "best that gradients pass by",
    "pixels": "best possible per pixel",
}
# Beyond this it is float32 that rounds, not the method.
EXACT = 100.0


def save(measured: Sequence[Any], factors: dict[str, float]) -> None:
    """Write the results' data, and the README's part.

    Args:
        measured: the scenes, the one that things are fitted on first.
        factors: of the rules.
    """
    fitted = measured[0]
    RESULTS.mkdir(parents=True, exist_ok=True)
    with replacing(RESULTS / "scores.json") as partial:
        scores = {
            one.case.name: {" ".join(map(str, key)): ways for key, ways in one.scores.items()} for one in measured
        }
        partial.write_text(json.dumps(scores, indent=1))
    numbers = {"factor of the rule": factors[RULES[0]]}
    for one in measured:
        for way in ("100P", "one value", RULES[0], "blocks", "pixels"):
            numbers[f"{one.case.name}, {way}: mean PSNR"] = one.mean_psnr(way)
    for key in (("SFM", "inserted", 4), ("SKB+OFM", "image", 4), ("SKB+OFM", "inserted", 4)):
        for way in ("2P", "100P", "one value", "together", RULES[0], "pixels"):
            numbers[f"{key[0]}, {key[1]}, M = {key[2]}, {way}: PSNR"] = psnr(fitted.scores[key][way]["rms"])
    Summary(
        name="layer_budgets",
        title="Layer budgets",
        question="Which z-thickness makes 2, 4 or 8 merged layers stand for all fragments of a deep scene?",
        answer=answer(measured, factors),
        tables=(by_scene(measured, factors), decibels(fitted), levels(fitted), best_factors(measured, factors)),
        figures=(
            Figure("figures/errors.png", "Error against the number of layers, by scene and method."),
            Figure("figures/images.png", "The machine in four layers by several thicknesses, and the errors."),
            Figure("figures/maps.png", "Complexity of the pixels, and thickness maps for SFM with four layers."),
        ),
        numbers=numbers,
        command="uv run python experiments/fit/layer_budgets/study.py",
    ).save(HERE)


def answer(measured: Sequence[Any], factors: dict[str, float]) -> str:
    """Return the study's answer in words."""
    fitted = measured[0]
    worst = max(fitted.scores[method, "image", count]["100P"]["rms"] for method in METHODS[:2] for count in BUDGETS)
    names = " / ".join(one.case.name for one in measured)

    values = " / ".join(f"{one.multiple(('SFM', 'inserted', 4)):.0f}" for one in measured)

    def gains(way: str) -> str:
        return " / ".join(f"{_gain(one, way):.1f}" for one in measured)

    return (
        "For the image alone the methods that sort want no thickness: their tail, an over in order, makes it exact for "
        f"every M, and 100P costs them up to {worst:.2f} levels of 255 (rms). SKB+OFM, and every method once a surface "
        f"is put among its layers, want one, and not the same for every scene: {values} P(z) ({names}; SFM, M = 4). "
        f"The rule t = min({factors[RULES[0]]:.2f}·extent/M, the M-th largest gap), its factor found on the machine "
        f"alone, gains {gains(RULES[0])} dB over 100P; a map of {BLOCK}² blocks {gains('blocks')}, the best thickness "
        f"of each pixel {gains('pixels')}."
        f"\n\n{gradients(fitted)}"
    )


def gradients(found: Any) -> str:
    """Return in words what gradients did."""

    def gains(method: str, measure: str, way: str, start: str) -> str:
        keys = [(method, measure, count) for count in BUDGETS]
        values = [psnr(found.scores[key][way]["rms"]) - psnr(found.scores[key][start]["rms"]) for key in keys]
        return " / ".join(f"{value:.1f}" for value in values)

    together, passed, searched = (
        gains("SFM", "inserted", way, "one value") for way in ("together", "on the way", "pixels")
    )
    moved = max(found.moved["SKB+OFM", "image", count] for count in BUDGETS)
    return (
        f"With a surface inserted a map fitted by gradient gains {together} dB over the best single value (SFM, M = "
        f"2 / 4 / 8); the best that each pixel passes by on the way {passed}, search {searched}. SKB+OFM's image is "
        f"piecewise constant in t: gradients move {100.0 * moved:.0f} % of its pixels. For SFM's image `study.toml` "
        f"and its like gain {gains('SFM', 'image', 'together', '100P')} dB from 100P and stay "
        f"{gains('SFM', 'image', '2P', 'together')} dB short of 2P: its best is t = 0, far away for a logarithm."
    )


def _gain(found: Any, way: str) -> float:
    return found.mean_psnr(way) - found.mean_psnr("100P")


def decibels(found: Any) -> Table:
    """Return the PSNR of the fitted scene by method, measure and way of choosing, for every number of layers."""

    def cell(method: str, measure: str, way: str) -> str:
        if way not in found.scores[method, measure, BUDGETS[0]]:
            return "–"
        values = [psnr(found.scores[method, measure, count][way]["rms"]) for count in BUDGETS]
        if min(values) > EXACT:
            return f"> {EXACT:.0f}"
        return " / ".join(f"{value:.1f}" if value < EXACT else f"> {EXACT:.0f}" for value in values)

    rows = [
        (method, measure, *(cell(method, measure, way) for way in WAYS))
        for measure in ("image", "inserted")
        for method in METHODS
    ]
    caption = "PSNR [dB] of the machine for M = 2 / 4 / 8: of the image, and with a surface inserted."
    return Table(("method", "measure", *WAYS.values()), tuple(rows), caption, further=True)


def levels(found: Any) -> Table:
    """Return mean and 99th percentile of the absolute error of the fitted scene."""

    def cell(method: str, measure: str, way: str, kind: str, form: str) -> str:
        if way not in found.scores[method, measure, BUDGETS[0]]:
            return "–"
        return " / ".join(format(found.scores[method, measure, count][way][kind], form) for count in BUDGETS)

    rows = [
        (method, measure, words, *(cell(method, measure, way, kind, form) for way in WAYS))
        for method, measure in OPEN
        for kind, words, form in (("mean", "mean", ".2f"), ("p99", "99 %", ".0f"))
    ]
    caption = "Mean and 99th percentile of the absolute error [levels of 255, linear light], M = 2 / 4 / 8."
    return Table(("method", "measure", "", *WAYS.values()), tuple(rows), caption, further=True)


def by_scene(measured: Sequence[Any], factors: dict[str, float]) -> Table:
    """Return the mean PSNR of every scene by what its thickness was fitted to."""
    columns = {
        "2P": "2P",
        "100P": "100P",
        "one value carried over": "one value for each row, the machine's",
        RULES[1]: f"{factors[RULES[1]]:.2f}·extent/M",
        RULES[0]: f"min({factors[RULES[0]]:.2f}·extent/M, gap)",
        "own factor": "the same, own factor",
        "one value": "one value, its own",
        "blocks": WAYS["blocks"],
        "pixels": WAYS["pixels"],
    }
    rows = []
    for one in measured:
        counts = one.case.counts[one.case.covered]
        cells = {way: f"{one.mean_psnr(way):.1f}" for way in columns}
        cells["own factor"] += f" ({one.factor(RULES[0]):.2f})"
        rows.append((one.case.name, f"{counts.mean():.0f}, {counts.max()}", *cells.values()))
    caption = (
        "Mean PSNR [dB] by scene, over SFM, exact and SKB+OFM with a surface inserted and the image of SKB+OFM, "
        "M = 2, 4, 8."
    )
    return Table(("scene", "fragments: mean, most", *columns.values()), tuple(rows), caption)


def best_factors(measured: Sequence[Any], factors: dict[str, float]) -> Table:
    """Return the rule's best factors by scene and number of layers, and what the one of the machine loses."""
    rows = []
    for one in measured:
        cells = []
        for count in BUDGETS:
            low, high = one.factors(RULES[0], count)
            cells += [f"{low:.2f} … {high:.2f}", f"{one.lost(RULES[0], factors[RULES[0]], count):.1f}"]
        rows.append((one.case.name, *cells))
    columns = [name for count in BUDGETS for name in (f"M = {count}", f"{factors[RULES[0]]:.2f} loses [dB]")]
    caption = (
        "The rule's factor that is best for a method and measure, least and largest; and the most that the one factor "
        "loses against it."
    )
    return Table(("scene", *columns), tuple(rows), caption, further=True)
