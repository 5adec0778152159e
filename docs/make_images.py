"""Make the pictures of the README again, each by the command that stands beside it there.

uv run python docs/make_images.py
"""

import shlex
import shutil
import tempfile
from pathlib import Path

from warpfrag.cli import main as warpfrag

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
STUDY = "scenes/studies/bunny_in_sphere.toml"
# Nearly opaque and thick: so both merging and beta are seen.
SPHERES = (
    "render scenes/three_spheres.toml --size 384x384 --thickness 0.8 "
    "--set red.opacity=0.95 --set green.opacity=0.95 --set blue.opacity=0.95"
)
# Pictures, and what renders them.
RENDERS = {
    "spheres_none.png": f"{SPHERES} --merge none",
    "spheres_beta_1.png": f"{SPHERES} --beta 1",
    "spheres_beta_0.png": f"{SPHERES} --beta 0",
}
# Pictures, and what they are called among the results of the fit.
FIT = {"fit_reference.png": "reference.png", "fit_before.png": "before.png", "fit_error.png": "error.png"}


def main() -> None:
    """Make all of them."""
    IMAGES.mkdir(exist_ok=True)
    for name, words in RENDERS.items():
        _run(f"{words} -o {shlex.quote(str(IMAGES / name))}")
    with tempfile.TemporaryDirectory() as folder:
        _run(f"fit {STUDY} -o {shlex.quote(folder)}")
        for name, result in FIT.items():
            shutil.copyfile(Path(folder) / result, IMAGES / name)


def _run(words: str) -> None:
    print("warpfrag", words)
    given = [str(ROOT / word) if word.startswith("scenes/") else word for word in shlex.split(words)]
    status = warpfrag(given)
    if status:
        raise SystemExit(status)


if __name__ == "__main__":
    main()
