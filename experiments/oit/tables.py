"""The tables of README.md: what the paper claims, and what was measured."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpfrag.files.saving import replacing

BEGIN, END = "<!-- results: begin (written by figures.py) -->", "<!-- results: end -->"


def report(documents: dict[str, Any]) -> str:
    """Return the tables of all figures there are numbers for, as Markdown."""
    parts = []
    if "10" in documents:
        numbers = documents["10"]["numbers"]
        parts += [_claims(documents), _scenes(numbers), _errors(numbers)]
    if "12" in documents:
        parts.append(_times(documents["12"]["numbers"]))
    return "\n\n".join(parts) + "\n"


def insert(path: Path, text: str) -> None:
    """Put text between the markers of a file.

    Raises:
        ValueError: the file lacks the markers.
    """
    content = path.read_text()
    before, begin, rest = content.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{path}: found no markers, expected {BEGIN} and {END}")
    with replacing(path) as temporary:
        temporary.write_text(f"{before}{begin}\n\n{text}\n{end}{after}")


def _claims(documents: dict[str, Any]) -> str:
    numbers = documents["10"]["numbers"]

    def mean(about: dict[str, Any], way: str) -> float:
        return about["errors"][way]["mean"]

    def each(word: Any) -> str:
        return "; ".join(f"{scene} {word(about)}" for scene, about in numbers.items())

    rows = [
        [
            "OIT with SFM: a negligible loss of quality against DFB (§5.1.1)",
            "mean error " + each(lambda about: f"{mean(about, 'DFB+SFM'):.2f}") + " levels of 255",
        ],
        [
            "OFM improves OIT where memory is limited: SKB+OFM against SKB (§5.1.1)",
            "error of SKB over that of SKB+OFM "
            + each(lambda about: f"{mean(about, 'SKB') / mean(about, 'SKB+OFM'):.2f}")
            + " (overflow mixed in the tail); "
            + each(lambda about: f"{mean(about, 'SKB, tail discarded') / mean(about, 'SKB+OFM, tail discarded'):.2f}")
            + " (discarded by both)",
        ],
        [
            "(ours) exact merging against SFM",
            "error of SFM over that of exact "
            + each(lambda about: f"{mean(about, 'DFB+SFM') / mean(about, 'exact'):.2f}"),
        ],
    ]
    if "11" in documents:
        errors = documents["11"]["numbers"]["errors"]
        ways = ("SKB", "SKB+OFM", "SKB+OFM, 100P", "MBT")
        found = ", ".join(f"{way} {errors[way]['mean']:.2f}" for way in ways)
        rows.append(
            [
                "OFM at 2P(z) mitigates wrong occlusion of surfels and coplanar text (Fig. 11)",
                f"mean difference from DFB+SFM: {found}",
            ]
        )
    if "12" in documents:
        timed = documents["12"]["numbers"]

        def ratio(seconds: dict[str, Any], way: str, other: str) -> float:
            return sum(seconds[way].values()) / sum(seconds[other].values())

        for words, way, other in (
            ("SFM's overhead in the resolve pass is negligible beside sorting (§5.1.2)", "DFB+SFM", "DFB"),
            ("OFM's performance loss in the store pass is insignificant (§5.1.2)", "SKB+OFM", "SKB"),
        ):
            found = "; ".join(f"{name}² {ratio(about['seconds'], way, other):.2f}" for name, about in timed.items())
            rows.append([words, f"time of {way} over that of {other}: {found}"])
    if "13" in documents:
        about = documents["13"]["numbers"]
        off = about["mean difference"]
        found = ", ".join(f"{way} {off[way]:.4f}" for way in ("SKB", "SKB+OFM", "DFB+SFM", "MBT, 4 moments"))
        rows.append(
            [
                "Few slots with OFM represent the separate layers of a ray (Fig. 13: 52 surfels, 10 layers)",
                f"{about['fragments']} fragments, {about['separate layers']} layers: mean difference in absorbance "
                + found,
            ]
        )
    return table(["the paper claims", "measured"], rows, "--")


def _scenes(numbers: dict[str, Any]) -> str:
    rows = []
    for scene, about in numbers.items():
        layers = about["layers"]
        rows.append(
            [
                scene,
                str(about["objects"]),
                f"{about['triangles']:,}",
                f"{layers['fragments'] / 1e6:.1f} M",
                str(layers["max"]),
                f"{layers['mean']:.1f}",
                f"{layers['centre']:.0f}",
            ]
        )
    columns = ["scene", "objects", "triangles", "fragments", "most layers", "mean where any", "mean at the centre"]
    return table(columns, rows, "-" + ":" * 6)


def _errors(numbers: dict[str, Any]) -> str:
    rows = []
    for way in next(iter(numbers.values()))["errors"]:
        cells = []
        for about in numbers.values():
            error = about["errors"][way]
            cells.append(f"{error['mean']:.2f} / {error['rmse']:.2f} / {error['p99']:.1f}")
        rows.append([way, *cells])
    return table(["mean / RMS / 99th percentile", *numbers], rows, "-" + ":" * len(numbers))


def _times(numbers: dict[str, Any]) -> str:
    ways = list(next(iter(numbers.values()))["seconds"])
    rows = []
    for way in ways:
        cells = []
        for about in numbers.values():
            passes = about["seconds"][way]
            cells.append(" + ".join(f"{1000.0 * seconds:,.0f}" for seconds in passes.values()))
        rows.append([way, *cells])
    columns = ["count + store + resolve [ms]", *(f"{name}²" for name in numbers)]
    return table(columns, rows, "-" + ":" * len(numbers))


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> str:
    """Return a Markdown table; `align` has ``-`` for a column to the left, ``:`` for one to the right."""
    lines = [columns, ["--:" if side == ":" else "---" for side in align], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
