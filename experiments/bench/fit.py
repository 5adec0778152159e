"""Iterations of a fit per second: one image, every method; an iteration is an image and its gradient (or Jacobian).

Concentric translucent spheres before an orthographic camera; each has two fragments in every pixel it covers.
"""

import argparse
import time
from functools import partial

import numpy as np
from measure import quiet_warp, set_threads, show

quiet_warp()

import warpfrag as wf  # noqa: E402
from warpfrag.fit import FitParameter, Reference, Study, fit  # noqa: E402
from warpfrag.fit.jacobian import Evaluation  # noqa: E402
from warpfrag.fit.problem import Problem  # noqa: E402
from warpfrag.scene.camera import Camera  # noqa: E402
from warpfrag.scene.scene import Scene  # noqa: E402
from warpfrag.scene.surface import SceneObject  # noqa: E402
from warpfrag.shapes.primitives import sphere  # noqa: E402


def nested_spheres(count: int, size: int) -> Scene:
    """Return spheres in one another that nearly fill a square image."""
    mesh, objects = sphere(1.0, 64), []
    for index in range(count):
        color = 0.5 + 0.5 * np.cos(2.0 * np.pi * (index / count + np.array([0.0, 1.0, 2.0]) / 3.0))
        matrix = np.diag([1.0 - 0.02 * index] * 3 + [1.0])
        objects.append(SceneObject(f"s{index}", mesh.vertices, mesh.faces, matrix, color, 0.3, 0.05, "scene"))
    camera = Camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), height=2.0, near=0.1, far=10.0, size=(size, size))
    return Scene(camera, objects, beta=0.5, layers=8)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--size", type=int, default=512, help="width and height")
    parser.add_argument("--spheres", type=int, default=7, help="spheres in one another")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads")
    parser.add_argument("--steps", type=int, default=8, help="timed iterations of each")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    scene = nested_spheres(arguments.spheres, arguments.size)
    thicknesses = {f"s{index}.thickness": 0.08 for index in range(arguments.spheres)}
    colors = {f"s{index}.color": [0.5, 0.5, 0.5] for index in range(arguments.spheres)}
    opacities = {f"s{index}.opacity": 0.4 for index in range(arguments.spheres)}
    everything = {"beta": 0.8, **thicknesses, **colors, **opacities}
    cases = [
        ("beta and a thickness per object", "least_squares", {"beta": 0.8, **thicknesses}),
        ("the same", "adam", {"beta": 0.8, **thicknesses}),
        ("thickness, colour, opacity per object", "least_squares", everything),
        ("the same", "adam", everything),
        ("one thickness per pixel", "adam", {"thickness": FitParameter(0.08, per="pixel")}),
        ("beta and thickness per pixel", "lbfgs", {"thickness": FitParameter(0.08, per="pixel"), "beta": 0.8}),
    ]
    rows = []
    for words, method, parameters in cases:
        study = Study(scene, Reference(true={}), parameters, method=method, steps=arguments.steps, tolerance=0.0)
        rate = jacobians(study, arguments.steps) if method == "least_squares" else steps(study)
        rows.append((words, method, str(sum(np.size(v.start) for v in study.prepared.parameters)), f"{rate:.1f}"))
    count = wf.capture(scene).count
    title = f"{arguments.size}², {count / 1e6:.2f} M fragments, {arguments.threads} threads"
    show(title, ("fitted", "method", "numbers", "iterations / s"), rows)


def jacobians(study: Study, repetitions: int) -> float:
    """Return images with Jacobian per second."""
    problem, loss = Problem(study), study.prepared.image_loss.robust
    evaluate = partial(Evaluation, problem, loss)
    evaluate(problem.start()).compress()
    begin = time.perf_counter()
    for step in range(repetitions):
        evaluate(problem.start() + 1e-3 * step).compress()
    return repetitions / (time.perf_counter() - begin)


def steps(study: Study) -> float:
    """Return images with gradient per second, from the times at which steps are reported."""
    times: list[float] = []
    result = fit(study, progress=lambda progress: times.append(time.perf_counter()))
    images = (result.evaluations - 1) if study.prepared.method == "lbfgs" else len(times) - 1
    return images / (times[-1] - times[0])


if __name__ == "__main__":
    main()
