#!/bin/sh
# OpenImageIO 3.2.2.0: flatten composites deep samples in stored order, and merge_overlaps cuts none.
#
# A red sample at depth 2 that is stored before a green one at depth 1 hides it. Two slabs, 1 ... 3
# and 2 ... 4, stay two and are composited one after the other: what OpenEXR calls tidy takes
# split() at every boundary, then sort(), then merge_overlaps(); flatten does none of it.
#
# Installs openimageio==3.2.2.0, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check openimageio==3.2.2.0 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import OpenImageIO as oiio

def deep(*samples):
    """Return an image of one pixel of samples (R, G, B, A, Z, ZBack)."""
    spec = oiio.ImageSpec(1, 1, 6, oiio.FLOAT)
    spec.channelnames, spec.deep = ("R", "G", "B", "A", "Z", "ZBack"), True
    image = oiio.ImageBuf(spec)
    image.set_deep_samples(0, 0, 0, len(samples))
    for number, sample in enumerate(samples):
        for channel, value in enumerate(sample):
            image.set_deep_value(0, 0, 0, channel, number, value)
    return image

image = deep((1, 0, 0, 1, 2, 2), (0, 1, 0, 1, 1, 1))
color = oiio.ImageBufAlgo.flatten(image).getpixel(0, 0)[:4]
samples = deep((0.5, 0, 0, 0.5, 1, 3), (0, 0.5, 0, 0.5, 2, 4)).deepdata()
samples.sort(0)
samples.merge_overlaps(0)
whole = samples.samples(0)
for depth in (1, 2, 3, 4):
    samples.split(0, depth)
samples.sort(0)
samples.merge_overlaps(0)
print("OpenImageIO", oiio.__version__, "flattens to", color, "and has", whole, "samples, cut first", samples.samples(0))
assert tuple(color) == (1.0, 0.0, 0.0, 1.0) and whole == 2 and samples.samples(0) == 3, "no longer so"
END
