"""Writes what study.py has measured: its data, and the answer and tables of README.md."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from budget import BUDGETS, METHODS, OPEN, psnr
from maps import BLOCK, RULES

from warpfrag.fit.summary import Figure, Summary, Table
from warpfrag.saving import replacing

HERE = Path(__file__).parent
RESULTS = Path("results") / "fit" / "layer_budgets"
WAYS = {
    "2P": "2P",
    "100P": "100P",
    "one value": "one value, fitted",
    "gradient": "map, by gradient",
    RULES[0]: "rule",
    "blocks": f"map, {BLOCK}² blocks",
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
        for way in ("2P", "100P", "one value", "gradient", RULES[0], "pixels"):
            numbers[f"{key[0]}, {key[1]}, M = {key[2]}, {way}: PSNR"] = psnr(fitted.scores[key][way]["rms"])
    Summary(
        name="layer_budgets",
        title="Layer budgets",
        question="Which z-thickness makes 2, 4 or 8 merged layers stand for all fragments of a deep scene?",
        answer=answer(measured, factors),
        tables=(decibels(fitted), levels(fitted), by_scene(measured, factors)),
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

    def shares(way: str) -> str:
        return " / ".join(f"{100.0 * _gain(one, RULES[0]) / _gain(one, way):.0f}" for one in measured)

    return (
        "For the image alone the methods that sort want no thickness: at t = 0 their tail, an over in order, makes the "
        f"image exact for every M, and 100P costs SFM and exact merging up to {worst:.2f} levels of 255 (rms). "
        "SKB+OFM, and every method once a surface is put among its layers, want one, and not the same for every scene: "
        f"for SFM, M = 4, the best single value is {values} P(z) ({names}). In the mean of these methods and "
        f"M = 2, 4, 8 the best thickness of each pixel gains {gains('pixels')} dB over 100P, a map of {BLOCK}² blocks "
        f"{gains('blocks')}, and the best single values of each scene {gains('one value')}. The rule t = "
        f"min({factors[RULES[0]]:.2f}·extent/M, the M-th largest gap), its factor found on the machine alone, gains "
        f"{gains(RULES[0])} dB: {shares('blocks')} % of what the map of blocks does, {shares('pixels')} % of what is "
        "possible."
        f"\n\n{gradients(fitted)}"
    )


def gradients(found: Any) -> str:
    """Return in words what gradients did."""

    def gains(method: str, measure: str, way: str, start: str) -> str:
        keys = [(method, measure, count) for count in BUDGETS]
        values = [psnr(found.scores[key][way]["rms"]) - psnr(found.scores[key][start]["rms"]) for key in keys]
        return " / ".join(f"{value:.1f}" for value in values)

    moved = max(found.moved["SKB+OFM", "image", count] for count in BUDGETS)
    inserted = found.moved["SFM", "inserted", 4]
    return (
        "Gradients hold fixed what merges. SKB+OFM's image is piecewise constant in t, as its mix does not ask how far "
        f"slabs overlap: gradients move {100.0 * moved:.0f} % of its pixels, and only search finds anything. With a "
        f"surface inserted they move {100.0 * inserted:.0f} % (SFM, M = 4). From the best single value Adam gains "
        f"{gains('SFM', 'inserted', 'gradient, together', 'one value')} dB for M = 2 / 4 / 8 if all pixels stop at the "
        f"same step, {gains('SFM', 'inserted', 'gradient', 'one value')} dB if each keeps the best that it came past "
        f"(search: {gains('SFM', 'inserted', 'pixels', 'one value')}). For SFM's image, best at t = 0, `study.toml` "
        f"and its like gain {gains('SFM', 'image', 'gradient', '100P')} dB from 100P."
    )


def _gain(found: Any, way: str) -> float:
    return found.mean_psnr(way) - found.mean_psnr("100P")


def decibels(found: Any) -> Table:
    """Return the PSNR of the fitted scene by method, measure and way of choosing, for every number of layers."""

    def cell(method: str, measure: str, way: str) -> str:
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
    return Table(("method", "measure", *WAYS.values()), tuple(rows), caption)


def levels(found: Any) -> Table:
    """Return mean and 99th percentile of the absolute error of the fitted scene."""

    def cell(method: str, measure: str, way: str, kind: str, form: str) -> str:
        return " / ".join(format(found.scores[method, measure, count][way][kind], form) for count in BUDGETS)

    rows = [
        (method, measure, words, *(cell(method, measure, way, kind, form) for way in WAYS))
        for method, measure in OPEN
        for kind, words, form in (("mean", "mean", ".2f"), ("p99", "99 %", ".0f"))
    ]
    caption = "Mean and 99th percentile of the absolute error [levels of 255, linear light], M = 2 / 4 / 8."
    return Table(("method", "measure", "", *WAYS.values()), tuple(rows), caption)


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
