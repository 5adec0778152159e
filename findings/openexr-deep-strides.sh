#!/bin/sh
# OpenEXR 3.5.3 (Python) writes the wrong deep samples where a pixel's array is not contiguous.
#
# The samples of a pixel are an array of their own. Of one that is a column of a larger array the
# strides are ignored: for 0, 2, 4 the file has 0, 1, 2, without a word. Flat channels are fine.
#
# Installs OpenEXR==3.5.3, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check OpenEXR==3.5.3 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import OpenEXR
import numpy as np
from importlib.metadata import version
pixels = np.empty((1, 1), object)
pixels[0, 0] = np.arange(6, dtype=np.float32)[::2]
header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
with OpenEXR.File(header, {"Z": pixels}) as file:
    file.write("a.exr")
with OpenEXR.File("a.exr") as file:
    found = file.channels()["Z"].pixels[0, 0].tolist()
print("OpenEXR", version("OpenEXR"), "gives", found, "for [0.0, 2.0, 4.0]")
assert found == [0.0, 1.0, 2.0], "no longer so"
END
