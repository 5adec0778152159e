"""Time to the first image on the command line: cold (nothing compiled yet), and warm, each in a new process."""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measure import ratio, show

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "bunny_in_sphere.toml"


def render(scene: Path, size: str | None, cache: Path) -> float:
    """Render in a new process with Warp's kernel cache in `cache`; return the time [s]."""
    command = [sys.executable, "-m", "warpfrag.cli", "render", str(scene), "-o", str(cache / "image.png")]
    if size is not None:
        command += ["--size", size]
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache / "kernels")}
    start = time.perf_counter()
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
    return time.perf_counter() - start


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", type=Path, default=SCENE, help="scene file")
    parser.add_argument("--size", metavar="WxH", help="size of the image; default the scene's")
    parser.add_argument("--repetitions", type=int, default=3, help="cold starts, each followed by two warm ones")
    arguments = parser.parse_args()
    cold, warm = [], []
    for _ in range(arguments.repetitions):
        with tempfile.TemporaryDirectory() as folder:
            cold.append(render(arguments.scene.resolve(), arguments.size, Path(folder)))
            warm += [render(arguments.scene.resolve(), arguments.size, Path(folder)) for _ in range(2)]
    rows = [
        [name, f"{statistics.median(times):.2f} s", f"{min(times):.2f} s", f"{max(times):.2f} s"]
        for name, times in (("cold", cold), ("warm", warm))
    ]
    show(f"warpfrag render {arguments.scene.name}, new process", ["kernel cache", "median", "least", "most"], rows)
    print(f"\ncold / warm: {ratio(statistics.median(cold), statistics.median(warm))}")


if __name__ == "__main__":
    main()
