"""Deep images put together and flattened: against the `deep_merge` and `flatten` of OpenImageIO.

Files are read before; both sides end with an image in memory. Reading is timed apart. First both images are compared:
where samples of one depth meet, OpenImageIO has rules of its own, so a share of the pixels may differ.
"""

import argparse
import os
import sys
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from measure import medians, milliseconds, quiet_warp, ratio, show

quiet_warp()

import warpfrag as wf  # noqa: E402

# Of the pixels, how many may differ by more than rounding.
MOST_DIFFERENT = 0.001


def flatten(images: list[wf.Fragments]) -> np.ndarray:
    """Put deep images together and composite them as OpenEXR says."""
    return wf.composite(wf.concat(*images), merge="exact", mix="optical_depth", beta=0.0)


def load(path: Path) -> Any:
    """Read a deep image with OpenImageIO."""
    image = oiio.ImageBuf(str(path))
    image.read()
    return image


def flatten_with_oiio(images: list[Any]) -> np.ndarray:
    """Do the same with OpenImageIO: premultiplied colour and opacity of the display window."""
    flat = oiio.ImageBufAlgo.flatten(reduce(oiio.ImageBufAlgo.deep_merge, images))
    return flat.get_pixels(oiio.FLOAT, flat.spec().roi_full)[..., :4]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="deep OpenEXR files of one display window")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads, of both sides")
    parser.add_argument("--repetitions", type=int, default=15, help="timed calls of each")
    arguments = parser.parse_args()
    os.environ["WARPFRAG_THREADS"] = str(arguments.threads)
    oiio.attribute("threads", arguments.threads)
    images, buffers = [wf.read_deep(file) for file in arguments.files], [load(file) for file in arguments.files]
    differ = np.abs(flatten(images) - flatten_with_oiio(buffers)).max(axis=2) > 1e-5
    if differ.mean() > MOST_DIFFERENT:
        sys.exit(f"warpfrag and OpenImageIO differ in {differ.mean():.2%} of the pixels")
    contests = {
        "merge + flatten": (lambda: flatten(images), lambda: flatten_with_oiio(buffers)),
        "read": (
            lambda: [wf.read_deep(file) for file in arguments.files],
            lambda: [load(file) for file in arguments.files],
        ),
    }
    rows = []
    for name, (ours, theirs) in contests.items():
        times = medians({"warpfrag": ours, "OpenImageIO": theirs}, arguments.repetitions)
        rows.append([name, *map(milliseconds, times.values()), ratio(times["OpenImageIO"], times["warpfrag"])])
    height, width = images[0].shape
    samples = sum(image.count for image in images)
    title = f"{len(images)} deep images of {width} × {height}, {samples} samples, {arguments.threads} thread(s)"
    show(title, ["", "warpfrag", "OpenImageIO", "OpenImageIO / warpfrag"], rows)
    print(f"pixels that differ: {np.count_nonzero(differ)} of {differ.size}")


if __name__ == "__main__":
    main()
