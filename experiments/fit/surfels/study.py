"""Surfels: opacity falloff, thickness and colours of a point set, fitted to renders of the mesh it is from.

Draws figures/, and writes points.ply, views/ and the numbers of README.md.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING

import figures  # noqa: E402
from cloud import load_bunny, render_mesh, sample_points, write_points  # noqa: E402
from discs import Discs  # noqa: E402
from fits import FALLOFF, OPAQUE, PAPER, RADIUS, Row, Setting, images_of, mean_psnr, reference_of  # noqa: E402
from tied import Tied, fit_tied  # noqa: E402

import warpfrag as wf  # noqa: E402
from warpfrag.capture.coverage import Coverage  # noqa: E402
from warpfrag.files.images import write_image  # noqa: E402
from warpfrag.fit import Progress, Reference, load_study  # noqa: E402
from warpfrag.fit.losses import psnr  # noqa: E402
from warpfrag.scene.names import Merge  # noqa: E402
from warpfrag.shapes.mesh import Mesh  # noqa: E402
from warpfrag.studies.summary import Figure, Summary, Table  # noqa: E402

HERE = Path(__file__).parent
COMMAND = "uv run python experiments/fit/surfels/study.py"
POINTS = 2000
# Thicknesses [spacings] and numbers of points of the curves, the latter as shares of the study's.
MULTIPLES = np.geomspace(1e-3, 30.0, 19)
SHARES = (0.25, 1.0, 4.0)
# Rims of opaque discs that are tried [spacings].
RIMS = (0.8, 1.0, 1.1, 1.2, 1.4, 1.6, 2.0)
# Of the views to fit those that judge learning rates and numbers of steps; study.toml has the best.
JUDGES = ("side_4", "side_8")
RATES, STEPS = (0.00375, 0.0075, 0.015), (40, 75, 150, 300)
MERGES: dict[Merge, str] = {"none": "plain over", "smooth": "SFM", "order_independent": "OFM", "exact": "exact"}
ALL = ("color", "opacity", "thickness")
CAPTION = "Mean PSNR [dB] of whole images in linear light, {} views that are fitted and {} that are held out:"


def main() -> None:
    """Measure, fit, draw, and write the README's numbers."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--size", type=int, help="width and height of the images (128)")
    parser.add_argument("--steps", type=int, help="of each fit (75)")
    parser.add_argument("--points", type=int, default=POINTS, help=f"how many points ({POINTS})")
    arguments = parser.parse_args()
    mesh = load_bunny()
    setting = prepare(mesh, arguments.size, arguments.steps, arguments.points)
    if arguments.size is None and arguments.points == POINTS:
        write_inputs(setting)
    tuned = tune(setting)
    rows, tied = fit_all(setting)
    ways: tuple[Merge, ...] = ("smooth", "order_independent", "exact")
    curves = {(discs, merge): curve(setting, discs, merge) for discs in (OPAQUE, FALLOFF) for merge in ways}
    by_count = {}
    for share in SHARES:
        other = replace(setting, discs=Discs(sample_points(mesh, round(share * arguments.points))))
        by_count[len(other.discs.points.points)] = curve(other, FALLOFF, "smooth")
    (HERE / "figures").mkdir(exist_ok=True)
    figures.images(setting, rows).savefig(HERE / "figures" / "images.png", dpi=150)
    figures.curves(setting, rows, tied, MULTIPLES, curves, by_count).savefig(HERE / "figures" / "curves.png", dpi=150)
    summarise(setting, rows, tied, tuned).save(HERE)


def prepare(mesh: Mesh, size: int | None, steps: int | None, count: int) -> Setting:
    """Return the study of study.toml with renders of the mesh as references, and the discs of the points."""
    study = load_study(HERE / "study.toml")
    views = []
    for view in study.prepared.views:
        camera = view.camera if size is None else view.camera.resized((size, size))
        views.append(replace(view, camera=camera, reference=Reference(render_mesh(mesh, camera))))
    study = replace(study, views=views, reference=None, steps=steps or study.prepared.steps)
    points = sample_points(mesh, count)
    tried = [Setting(study, Discs(points), Discs(points, rim)) for rim in RIMS]
    return max(tried, key=lambda each: mean_psnr(each.draw(OPAQUE, 0.0).images, each.views(held_out=False)))


def write_inputs(setting: Setting) -> None:
    """Write what study.toml reads: the points, and the references."""
    write_points(HERE / "points.ply", setting.discs.points)
    (HERE / "views").mkdir(exist_ok=True)
    for view in setting.study.prepared.views:
        write_image(HERE / "views" / f"{view.name}.png", reference_of(view))


@dataclass(frozen=True)
class Tuned:
    """A learning rate and a number of steps, judged by views that are neither fitted nor held out.

    Attributes:
        levels: mean PSNR of these views, at 10 P(z) and with the thickness fitted [dB].
        thickness: found [spacings].
    """

    levels: tuple[float, float]
    thickness: float


def tune(setting: Setting) -> dict[tuple[float, int], Tuned]:
    """Fit colours and opacities without the judges, at every learning rate, and judge along the way."""
    views = [replace(view, held_out=view.name in JUDGES) for view in setting.views(held_out=False)]
    most = max((steps for steps in STEPS if steps <= 4 * int(setting.study.prepared.steps or 0)), default=STEPS[0])
    found = {}
    for rate in RATES:
        study = replace(setting.study, views=views, learning_rate=rate, steps=most + 1, patience=most + 1)
        tuning = replace(setting, study=study)
        paper = judged(tuning, ("color", "opacity"), PAPER)
        free = judged(tuning, ALL, setting.spacing)
        for steps in paper:
            thickness = free[steps][1] / setting.spacing
            found[rate, steps] = Tuned((paper[steps][0], free[steps][0]), thickness)
            print(f"rate {rate:g}, {steps} steps: {found[rate, steps]}", flush=True)
    return found


def judged(setting: Setting, fitted: Sequence[str], thickness: float) -> dict[int, tuple[float, float]]:
    """Fit, and return the mean PSNR of the views held out [dB] and the thickness [P(z)] after some of the steps."""
    study, views, found = setting.study_of(FALLOFF, fitted, thickness), setting.views(held_out=True), {}

    def look(progress: Progress) -> None:
        # What is reported is what a step begins with.
        if progress.step - 1 in STEPS:
            values = {name: np.asarray(value, np.float32) for name, value in progress.parameters.items()}
            images = {v.name: wf.render(study.scene, v.camera, parameters=values) for v in views}
            now = float(values.get("points.thickness", thickness))
            found[progress.step - 1] = mean_psnr(images, views), now

    wf.fit(study, progress=look)
    return found


def fit_all(setting: Setting) -> tuple[dict[str, Row], Tied]:
    """Draw the points in all ways, those without fits first."""
    rows: dict[str, Row] = {}

    def add(name: str, row: Row) -> None:
        rows[name] = row
        levels = [mean_psnr(row.images, setting.views(held_out)) for held_out in (False, True)]
        print(f"{name}: {row.thickness:.0f} P, {levels[0]:.2f} dB, held out {levels[1]:.2f} dB", flush=True)

    for discs in (OPAQUE, FALLOFF):
        for thickness, words in ((0.0, "over"), (PAPER, "10 P"), (setting.spacing, "one spacing")):
            add(f"{discs}, {words}", setting.draw(discs, thickness))
    for discs in (OPAQUE, FALLOFF):
        add(f"{discs}, color, 10 P", setting.fit(discs, ("color",), PAPER))
        add(f"{discs}, color, t", setting.fit(discs, ("color", "thickness"), setting.spacing))
    add("all, over", setting.fit(FALLOFF, ("color", "opacity"), 0.0, "none"))
    add("all, 10 P", setting.fit(FALLOFF, ("color", "opacity"), PAPER))
    add("all, t", setting.fit(FALLOFF, ALL, setting.spacing))
    # OFM is constant in the thickness but where slabs begin to overlap: there is no slope to follow.
    add("all, OFM", setting.fit(FALLOFF, ("color", "opacity"), rows["all, t"].thickness, "order_independent"))
    add("all, exact", setting.fit(FALLOFF, ALL, setting.spacing, "exact"))
    tied = fit_tied(setting.study_of(FALLOFF, ALL, setting.spacing), setting.discs, RADIUS)
    add("tied", Row("by point", ("color", "opacity", "radius", "thickness"), "smooth", tied.thickness, tied.images))
    found = wf.fit(setting.study)
    add("study.toml", Row("corners only", ALL, "smooth", float(found.found["points.thickness"]), images_of(found)))
    return rows, tied


def curve(setting: Setting, discs: str, merge: Merge) -> np.ndarray:
    """Return the mean PSNR of the held-out views without a fit at 0 and at each of `MULTIPLES` [dB]."""
    scene = setting.scene(discs, 0.0, merge)
    views = setting.views(held_out=True)
    coverages = [Coverage.of(scene, view.camera) for view in views]
    levels = []
    for thickness in (0.0, *(MULTIPLES * setting.spacing)):
        images = {}
        for view, coverage in zip(views, coverages, strict=True):
            fragments = coverage.shade({"points.thickness": np.float32(thickness)})
            images[view.name] = np.asarray(wf.composite(fragments, scene.beta, max_layers=scene.layers, merge=merge))
        levels.append(mean_psnr(images, views))
    return np.array(levels)


def gaps(setting: Setting) -> np.ndarray:
    """Return how far the two nearest discs are apart in each pixel of the held-out views [P(z)]."""
    camera, scene = setting.study.scene.camera, setting.scene(FALLOFF, 0.0)
    found = []
    for view in setting.views(held_out=True):
        fragments = wf.capture(scene, view.camera)
        first = fragments.offsets[:-1][np.diff(fragments.offsets) >= 2]
        near, next_one = fragments.depth[first].astype(np.float64), fragments.depth[first + 1]
        found.append((next_one - near) / wf.z_resolution(near, camera.near, camera.far))
    return np.concatenate(found)


def summarise(setting: Setting, rows: dict[str, Row], tied: Tied, tuned: dict[tuple[float, int], Tuned]) -> Summary:
    """Put the numbers into words and tables."""
    held_out, fitted = setting.views(held_out=True), setting.views(held_out=False)
    level = {name: mean_psnr(row.images, held_out) for name, row in rows.items()}
    spacing, apart = setting.spacing, gaps(setting)
    thick = {name: row.thickness / spacing for name, row in rows.items()}
    cells = tuple(
        (
            row.discs,
            ", ".join(row.fitted) or "–",
            MERGES[row.merge],
            f"{row.thickness:.0f}",
            f"{thick[name]:.3g}",
            f"{mean_psnr(row.images, fitted):.2f}",
            f"{level[name]:.2f}",
        )
        for name, row in rows.items()
    )
    merged = [psnr(rows["all, t"].images[v.name], reference_of(v)) for v in held_out]
    paper = [psnr(rows["all, 10 P"].images[v.name], reference_of(v)) for v in held_out]
    gain = np.subtract(merged, paper)
    low, middle, high = np.quantile(tied.radius, (0.25, 0.5, 0.75))
    answer = (
        f"10 P(z) is {PAPER / spacing:.4f} spacings of the points and changes plain over by "
        f"{level['opaque, 10 P'] - level['opaque, over']:.2f} dB: of the pixels where discs overlap only "
        f"{np.mean(apart < PAPER):.1%} have the two nearest within it. Fitted with the colours, the thickness is "
        f"{thick['opaque, color, t']:.1f} spacings for opaque discs, {thick['falloff, color, t']:.1f} for discs that "
        f"fall off, and {thick['all, t']:.1f} where opacities are fitted as well: "
        f"{level['opaque, color, t'] - level['opaque, color, 10 P']:+.1f}, "
        f"{level['falloff, color, t'] - level['falloff, color, 10 P']:+.1f} and {gain.mean():+.1f} dB in held-out "
        f"views over the same fit at 10 P(z), the last better in {np.sum(gain > 0.0)} of {len(gain)} views. All "
        f"fitted: {level['all, t']:.1f} dB, from {level['opaque, over']:.1f} for opaque discs of the radius that suits "
        f"them ({setting.opaque.rim:g} spacings). With one radius of falloff for each point its median is {middle:.2f} "
        f"spacings (quartiles {low:.2f} and {high:.2f}), at {level['tied']:.1f} dB."
    )
    tuning = (
        f"By learning rate and steps: mean PSNR of {' and '.join(JUDGES)} [dB], left out of these fits, at 10 P(z) / "
        "with the thickness fitted (the thickness found [spacings]). The other fits take "
        f"{setting.study.learning_rate:g} and {setting.study.prepared.steps} steps."
    )
    return Summary(
        name="surfels",
        title="Surfels",
        question="What must a point set's opacity falloff, thickness and colours be to look like the mesh it is from?",
        answer=answer,
        tables=(
            Table(
                ("discs", "fitted", "merging", "t [P(z)]", "t [spacings]", "fitted views", "held out"),
                cells,
                CAPTION.format(len(fitted), len(held_out)),
            ),
            Table(
                ("learning rate", *(f"{steps} steps" for steps in STEPS)),
                tuple((f"{rate:g}", *(tuning_cell(tuned.get((rate, steps))) for steps in STEPS)) for rate in RATES),
                tuning,
                further=True,
            ),
        ),
        figures=(
            Figure("figures/images.png", "A held-out view by method, and its errors."),
            Figure("figures/curves.png", "PSNR by thickness and number of points, and the opacities found."),
        ),
        numbers={
            **{f"{name} [dB]": value for name, value in level.items()},
            **{f"{name} [spacings]": thick[name] for name, row in rows.items() if "thickness" in row.fitted},
            "median radius [spacings]": float(middle),
            "rim of opaque discs [spacings]": setting.opaque.rim,
        },
        command=COMMAND,
    )


def tuning_cell(found: Tuned | None) -> str:
    """Word what a learning rate and number of steps came to; None where it was not tried."""
    if found is None:
        return "–"
    paper, free = found.levels
    return f"{paper:.2f} / {free:.2f} ({found.thickness:.2g})"


if __name__ == "__main__":
    main()
