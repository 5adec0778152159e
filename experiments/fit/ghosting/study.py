"""Fits beta and thickness maps to an image in which inner parts show through in a region drawn by hand.

Makes the target, fits, draws `figures/` and writes the numbers of README.md.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

from figures import draw  # noqa: E402
from target import MODULATION, Target, make_target  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.files.images import write_image  # noqa: E402
from warpfrag.fit import Reference, Study, load_study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.studies.summary import Figure, Summary, Table  # noqa: E402

HERE = Path(__file__).parent
OBJECTS = ("outer", "inner", "gem")
# What the paper does by hand: large slabs for all, here half of the large bunny's depth [scene units], at beta = 1.
BY_HAND = {"thickness": 0.6, "beta": 1.0}
# So thick that more makes no difference [scene units].
ENDLESS = 1e4


def main() -> None:
    """Make the target, fit everything, draw it and write it down."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, help="width and height of the images [pixels]; default the scene's, 192")
    parser.add_argument("--steps", type=int, help="steps of each map's fit; default the study file's, 240")
    arguments = parser.parse_args()
    scene = wf.load_scene(HERE / "bunnies.toml")
    write_image(HERE / "target.png", make_target(scene).image)
    study = load_study(HERE / "study.toml")
    study = replace(study, steps=arguments.steps or study.steps)
    if arguments.size:
        scene = replace(scene, camera=scene.camera.resized((arguments.size, arguments.size)))
        study = replace(study, scene=scene, reference=Reference(image=make_target(scene).image))
    target = make_target(scene)
    images, found = fit_all(study)
    scores = {name: decibels(image, target) for name, image in images.items()}
    levels = {name: score["all"] for name, score in scores.items()}
    draw(target, shown(images), levels, maps_of(found, scene), HERE / "figures")
    report(target, scene, scores, found)


def fit_all(study: Study) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
    """Return the image of each way to choose thicknesses and beta, and their values, of those that fit and by hand."""
    scene, given = study.scene, study.parameters
    images = {
        "no merging": wf.render(scene, merge="none"),
        "by hand": wf.render(scene, parameters=BY_HAND),
    }
    single = {name: replace(p, per=None, smoothness=0.0, levels=1) for name, p in given.items() if name != "beta"}
    beta = given["beta"].start
    maps = {name: parameter for name, parameter in given.items() if name != "beta"}
    alone = {name: replace(parameter, smoothness=0.0, levels=1) for name, parameter in maps.items()}
    squares: dict[str, Any] = {"method": "least_squares", "steps": None, "patience": None}
    studies = {
        "one thickness": replace(study, parameters={"thickness": single["inner.thickness"], "beta": beta}, **squares),
        "one per object": replace(study, parameters={**single, "beta": beta}, **squares),
        "one map": replace(study, parameters={"thickness": maps["inner.thickness"], "beta": beta}),
        "a map per object, each pixel alone": replace(study, parameters={**alone, "beta": beta}),
        "a map per object": replace(study, parameters={**maps, "beta": beta}),
        "a map per object, and of β": study,
    }
    found: dict[str, dict[str, Any]] = {"by hand": BY_HAND}
    for name, one in studies.items():
        result = wf.fit(one)
        images[name], found[name] = result.after, result.found
        print(f"{name}: {result.lines()[-1]}", flush=True)
    return images, found


def shown(images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the images of the figure, with their titles."""
    names = ("no merging", "by hand", "one per object", "one map", "a map per object", "a map per object, and of β")
    return {name: images[name] for name in names}


def maps_of(found: dict[str, dict[str, Any]], scene: wf.Scene) -> dict[str, np.ndarray]:
    """Return the maps of the last fit, each only where the image may depend on it."""
    fragments = wf.capture(scene)
    pixel = fragments.pixel
    seen = [
        np.isin(np.arange(fragments.pixel_count), pixel[fragments.object_id == index]).reshape(fragments.shape)
        for index in range(len(OBJECTS))
    ]
    last = list(found.values())[-1]
    maps = {
        f"{title} bunny": np.where(seen[index], last[f"{name}.thickness"], np.nan)
        for index, (name, title) in enumerate((("outer", "large"), ("inner", "small")))
    }
    return {**maps, "β": np.where(seen[0], last["beta"], np.nan)}


def decibels(image: np.ndarray, target: Target) -> dict[str, float]:
    """Return the peak signal-to-noise ratio of each area [dB], against a peak of 1 in linear light."""
    return {name: psnr(image, target.image, area) for name, area in target.areas.items()}


def report(
    target: Target, scene: wf.Scene, scores: dict[str, dict[str, float]], found: dict[str, dict[str, Any]]
) -> None:
    """Write README.md, numbers.json and summary.json."""
    endless = wf.render(scene, parameters={"outer.thickness": ENDLESS, "beta": 1.0})
    limit = decibels(endless, target)["back wall"]
    by_object, best = scores["one per object"], scores["a map per object, and of β"]
    maps = scores["a map per object"]
    answer = (
        f"With a thickness map for each object the image comes to {maps['all']:.1f} dB of the target, with a map of β "
        f"as well to {best['all']:.1f} dB; the best single thickness of each object reaches {by_object['all']:.1f} dB, "
        f"and shows inner parts outside the region too ({by_object['outside']:.1f} dB there, maps "
        f"{best['outside']:.1f} dB). Over the inner parts these are {maps['inner parts']:.1f}, "
        f"{best['inner parts']:.1f} and {by_object['inner parts']:.1f} dB; on the back wall even endless slabs "
        f"only reach {limit:.1f} dB."
    )
    rows = [
        (name, _values(found.get(name)), *(f"{score[area]:.1f}".replace("inf", "–") for area in target.areas))
        for name, score in scores.items()
    ]
    caption = "PSNR [dB] by area, in linear light; – where the image is the target."
    Summary(
        name="ghosting",
        title="Ghosting",
        question="Can β and thickness maps stand in for an opacity that was modulated by hand?",
        answer=answer,
        tables=(Table(("thickness", "values", *target.areas), tuple(rows), caption),),
        figures=(
            Figure("figures/ghosting.png", "Scene with the pen's line, target, fits, and the error of the last"),
            Figure("figures/maps.png", "The thickness maps and the map of β that were found"),
        ),
        numbers={
            **{f"{name}, {area}": scores[name][area] for name in found for area in ("inner parts", "back wall", "all")},
            "limit, back wall": limit,
            "modulation": MODULATION,
        },
        command="uv run python experiments/fit/ghosting/study.py",
    ).save(folder=HERE)


def _values(values: dict[str, Any] | None) -> str:
    """Word those parameters that are single numbers."""
    words = {name.removesuffix(".thickness"): value for name, value in (values or {}).items() if np.ndim(value) == 0}
    return ", ".join(f"β {value:.2f}" if name == "beta" else f"{name} {value:.2g}" for name, value in words.items())


if __name__ == "__main__":
    main()
