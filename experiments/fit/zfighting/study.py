"""How many P(z) thick slabs must be for coplanar planes not to speckle, by what their depths went through.

Measures, fits `study.toml`, draws `figures/` and writes the numbers of README.md.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

from figures import NAMES, draw  # noqa: E402
from planes import BUFFERS, FOV, Setting, make_pair  # noqa: E402
from speckle import VISIBLE, WAYS, Case, clear_from, examine, left_over, offset_curve  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.fit import load_study  # noqa: E402
from warpfrag.studies.summary import Figure, Summary, Table  # noqa: E402

HERE = Path(__file__).parent
# The paper's multiples: in general, for points, in its study of transparency.
PAPER = (2.0, 10.0, 100.0)
DEPTHS = (1.3, 2.0, 5.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 5000.0)
RATIOS = (4.0, 10.0, 1e2, 1e4, 1e6)
TILTS = (0.0, 15.0, 30.0, 45.0, 55.0, 65.0, 75.0)
ORIGINS = (1.0, 10.0, 100.0, 1000.0)
BITS = (16, 20, 24, 28)
# Depth buffers of figures and rule; a float32 z-buffer is much as a 24-bit one.
SHOWN = ("fixed", "rasteriser", "eye")
OPACITIES = (0.3, 0.8, 0.99)
MULTIPLES = np.geomspace(0.25, 4096.0, 85)
OFFSETS = (*np.arange(0.0, 4.0, 0.25), *np.geomspace(4.0, 400.0, 21))
# Of the table of planes that are nearly coplanar [P(z)]; and the multiples tried there, 9 % apart.
APART = (0.0, 1.0, 2.0, 5.0)
APART_MULTIPLES = np.geomspace(0.25, 8192.0, 121).tolist()
# How near the near plane the far one varies [near].
CLOSE_BY = 1.8
# Depth of the planes in study.toml [near].
FITTED_DEPTH = 2.0
# Unit in the last place of a float32 between 1 and 2.
EPSILON = 2.0**-23


def main() -> None:
    """Measure everything, draw it and write it down."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, default=128, help="width and height of the images [pixels]")
    base = Setting(size=parser.parse_args().size)
    pair = make_pair(base)
    data: dict[str, Any] = {
        "depth": [examine(replace(base, z=z)) for z in DEPTHS],
        "ratio": [examine(replace(base, z=CLOSE_BY, far=ratio)) for ratio in RATIOS],
        "tilt": [examine(replace(base, tilt=tilt), SHOWN) for tilt in TILTS],
        "origin": [examine(replace(base, origin=origin), SHOWN) for origin in ORIGINS],
        "bits": [examine(replace(base, bits=bits)) for bits in BITS],
        "opacity": [examine(replace(base, opacity=opacity), ("fixed",), tuple(WAYS)) for opacity in OPACITIES],
        "multiples": MULTIPLES,
        "curves": {way: {name: left_over(pair, name, way, MULTIPLES) for name in SHOWN[:2]} for way in WAYS},
        "apart": {offset: apart(replace(base, offset=offset)) for offset in APART},
        "offsets": OFFSETS,
        "offset": {
            "none": offset_curve(base, "fixed", "SFM", 0.0, OFFSETS),
            **{f"{k:g} P": offset_curve(base, "fixed", "SFM", k, OFFSETS) for k in PAPER},
            "2 P, OFM": offset_curve(base, "fixed", "OFM", 2.0, OFFSETS),
        },
    }
    data["rule"] = find_rule([case for key in ("depth", "ratio", "tilt", "origin") for case in data[key]])
    data["fit"] = fit()
    draw(data, base, HERE / "figures")
    report(data)


def apart(setting: Setting) -> dict[str, dict[str, float]]:
    """Return the multiples from which on nearly coplanar planes do not speckle, by way of merging and buffer."""
    pair = make_pair(setting)
    return {way: {name: clear_from(pair, name, way, APART_MULTIPLES) for name in BUFFERS} for way in ("OFM", "SFM")}


def sources(setting: Setting, buffer: str) -> tuple[float, ...]:
    """Return what the noise of a depth buffer may come from, each in multiples of P(z); see `find_rule`."""
    rasterised = float(buffer == "rasteriser")
    return (
        float(buffer != "eye"),
        rasterised * 2.0 ** (setting.bits - 24),
        rasterised * setting.footprint / 256.0 / setting.resolution,
        EPSILON * setting.z / setting.resolution,
        EPSILON * setting.origin * setting.z / setting.resolution,
    )


def find_rule(cases: list[Case]) -> dict[str, Any]:
    """Find the thinnest slabs that merge coplanar planes in every case, as a sum over what noise comes from.

    Sources: P(z), rounding in the z-buffer; P(z) of 24 bits, projection in float32; 1/256 of the recession from pixel
    to pixel, rounding of corners in the image; and float32's rounding of the distance, and of world coordinates.
    """
    from scipy.optimize import linprog

    found = [(case, buffer, k) for case in cases for buffer, k in case.smallest["OFM"].items() if buffer != "float"]
    rows = np.array([sources(case.setting, buffer) for case, buffer, _ in found])
    needed = np.array([k for *_, k in found])
    # Enough in every case, and the least in sum; relative to what is needed, as cases differ by orders of magnitude.
    weight = 1.0 / np.maximum(needed, rows.max(axis=1))
    factors = linprog((rows * weight[:, None]).sum(axis=0), A_ub=-rows, b_ub=-needed).x
    pairs = zip(found, rows @ factors, strict=True)
    return {"factors": factors, "cases": [(buffer, given, k) for (_, buffer, k), given in pairs]}


def fit() -> dict[str, float]:
    """Fit study.toml; return what it found, and the share of speckled pixels of the two planes before and after."""
    study = load_study(HERE / "study.toml")
    result = wf.fit(study)
    fragments = wf.capture(study.scene, sort=False)
    pixel = fragments.pixel
    seen = np.bincount(pixel, weights=2.0**fragments.object_id, minlength=fragments.pixel_count)
    # Red and blue, without green before them.
    both = (seen == 3.0).reshape(fragments.shape)

    def speckled(image: np.ndarray) -> float:
        return float(np.mean(np.abs(image - result.reference).max(axis=-1)[both] > VISIBLE))

    return {
        "multiple": float(result.found["thickness"]),
        "before": speckled(result.before),
        "after": speckled(result.after),
    }


def report(data: dict[str, Any]) -> None:
    """Write README.md, numbers.json and summary.json."""
    storage, projection, corners, distance, world = data["rule"]["factors"]
    ratios = {case.setting.opacity: _ratios(case) for case in data["opacity"]}
    depth, tilt = data["depth"], data["tilt"]
    rasterised = [case.smallest["OFM"]["rasteriser"] for key in ("depth", "ratio", "tilt") for case in data[key]]
    own = [case.setting.z for case in depth if case.smallest["OFM"]["eye"] <= PAPER[0]]
    fixed = max(case.smallest["OFM"]["fixed"] for key in ("depth", "ratio", "tilt") for case in data[key])
    least, most = min(map(min, ratios.values())), max(map(max, ratios.values()))
    found = data["fit"]
    enough = max(offset for offset, found in data["apart"].items() if found["OFM"]["fixed"] <= PAPER[0])
    size = depth[0].setting.size
    answer = (
        f"{fixed:.1f} P(z) merges what a 24-bit z-buffer's own rounding sets apart, at every depth, near/far ratio and "
        f"tilt, so the paper's 2 P(z) is enough, also for planes that are {enough:g} P(z) apart. After a rasteriser's "
        f"rounding it takes {min(rasterised):.0f} to {max(rasterised):.0f} P(z) (at {size} × {size} pixels, {FOV:g}°; "
        f"in proportion to a pixel's size), for warpfrag's float32 distances less than 2 P(z) from z = {min(own):g} "
        f"near on. That is for an even mix (OFM): SFM goes on showing the order by noise / thickness, which falls "
        f"below 1/255 only at {least:.0f} to {most:.0f} times the noise."
    )
    needed = next(case.smallest["SFM"]["eye"] for case in depth if case.setting.z == FITTED_DEPTH)
    finer = [case.smallest["OFM"]["rasteriser"] for case in data["bits"]]
    fitted = (
        f"`study.toml` fits the thickness, from 2 P(z), to an even mix of two planes at z = {FITTED_DEPTH:g} near, "
        f"where a third one 200 P(z) before them must stay apart: {found['multiple']:.0f} P(z), as thick as the gap "
        f"allows, and above the {needed:.0f} P(z) of the table. Of the pixels of these two {found['before']:.1%} "
        f"speckle at 2 P(z), {found['after']:.1%} after the fit."
    )
    shared = f"{distance:.1f} ε z + {world:.1f} ε R"
    tables = (
        _by_buffer(
            "z [near]",
            {f"{c.setting.z:g}": c.smallest for c in depth},
            f"Smallest multiple of P(z) without speckle, OFM / SFM at β = 1; far plane at 10⁴ near, tilt 55°, opacity "
            f"0.8, {size} × {size} pixels, {FOV:g}°; – where no more than 0.1 % of the pixels speckle anyway.",
        ),
        Table(
            ("depth buffer", "thickness that merges coplanar planes"),
            (
                (NAMES["eye"], shared),
                (NAMES["fixed"], f"{storage:.1f} P(z) + {shared}"),
                (NAMES["rasteriser"], f"{storage + projection:.1f} P(z) + {shared} + {corners:.1f} p / 256"),
            ),
            "The rule: the least that is enough in all cases of figure (c). ε = 2⁻²³; R: how far the scene is from the "
            "origin of the world; p: how far the surface recedes from one pixel to the next.",
        ),
        _by_buffer(
            "far / near",
            {f"{c.setting.far:g}": c.smallest for c in data["ratio"]},
            f"The same by the ratio of the far and the near plane, at z = {CLOSE_BY:g} near.",
            further=True,
        ),
        _by_buffer(
            "apart by [P(z)]",
            {f"{offset:g}": found for offset, found in data["apart"].items()},
            "The same for planes that are nearly coplanar, at z = 10 near: multiples from which on nothing speckles, "
            "to 9 %.",
            further=True,
        ),
        Table(
            ("bits", NAMES["rasteriser"].replace("24-bit ", "")),
            tuple((bits, f"{multiple:.1f}") for bits, multiple in zip(BITS, finer, strict=True)),
            "OFM, by the bits of z-buffer and P, at z = 10 near: a rasteriser's rounding stays.",
            further=True,
        ),
        Table(
            ("opacity", "β = 1", "β = 0"),
            tuple((f"{opacity:g}", *(f"{ratio:.0f}" for ratio in pair)) for opacity, pair in ratios.items()),
            "What to multiply the rule with for SFM to be even to 1/255.",
            further=True,
        ),
    )
    numbers = {
        **{f"fixed, OFM, z = {c.setting.z:g}": c.smallest["OFM"]["fixed"] for c in depth},
        **{f"rasterised, OFM, tilt {c.setting.tilt:g}": c.smallest["OFM"]["rasteriser"] for c in tilt},
        **{f"warpfrag, SFM, z = {c.setting.z:g}": c.smallest["SFM"]["eye"] for c in depth},
        **{f"SFM / OFM, opacity {opacity:g}": pair[0] for opacity, pair in ratios.items()},
        **{f"fixed, OFM, far = {c.setting.far:g}": c.smallest["OFM"]["fixed"] for c in data["ratio"]},
        **{f"warpfrag, OFM, far = {c.setting.far:g}": c.smallest["OFM"]["eye"] for c in data["ratio"]},
        **{f"fixed, OFM, {offset:g} P apart": found["OFM"]["fixed"] for offset, found in data["apart"].items()},
        **{f"rasterised, OFM, {count} bits": multiple for count, multiple in zip(BITS, finer, strict=True)},
        "rule, P": storage,
        "rule, P if rasterised": projection,
        "rule, p / 256": corners,
        "rule, ε z": distance,
        "rule, ε origin": world,
        "fit [P]": found["multiple"],
        "fit, speckled after": found["after"],
    }
    Summary(
        name="zfighting",
        title="z-fighting",
        question="How many P(z) thick must slabs be for coplanar planes not to speckle?",
        answer=f"{answer}\n\n{fitted}",
        tables=tables,
        figures=(
            Figure("figures/speckle.png", "Coplanar planes at z = 10 near, as two depth buffers leave them"),
            Figure("figures/multiples.png", "Speckle by thickness; smallest multiples; the rule; offset planes"),
        ),
        numbers=numbers,
        command="uv run python experiments/fit/zfighting/study.py",
    ).save(folder=HERE)


def _by_buffer(head: str, found: dict[str, dict[str, dict[str, float]]], caption: str, further: bool = False) -> Table:
    """Return a table of multiples, OFM / SFM, a column for each depth buffer."""
    rows = tuple(
        (label, *(f"{_word(ways['OFM'][name])} / {_word(ways['SFM'][name])}" for name in BUFFERS))
        for label, ways in found.items()
    )
    return Table((head, *(NAMES[name] for name in BUFFERS)), rows, caption, further)


def _ratios(case: Case) -> tuple[float, float]:
    noise = case.smallest["OFM"]["fixed"]
    return case.smallest["SFM"]["fixed"] / noise, case.smallest["SFM, β = 0"]["fixed"] / noise


def _word(multiple: float) -> str:
    if multiple == 0.0:
        return "–"
    return f"{multiple:.2g}" if multiple < 1.0 else f"{multiple:.3g}" if multiple < 1000.0 else f"{multiple:.0f}"


if __name__ == "__main__":
    main()
