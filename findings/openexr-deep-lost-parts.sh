#!/bin/sh
# OpenEXR 3.5.3 (Python): a part whose pixels are cut off is left out of a file that opens without error.
#
# Of a file of two deep parts that ends early the second is gone: parts has one entry, the header
# alone has two. What went wrong is written to standard error, nothing is raised. A file of one part
# opens with none.
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
pixels = np.empty((1, 2), object)
pixels[:] = [[np.ones(3, np.float32), np.ones(2, np.float32)]]
part = lambda name: OpenEXR.Part({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, "name": name}, {"Z": pixels}, name)
with OpenEXR.File([part("near"), part("far")]) as file:
    file.write("a.exr")
with open("a.exr", "rb") as file:
    data = file.read()
with open("b.exr", "wb") as file:
    file.write(data[:-4])
with OpenEXR.File("b.exr") as file, OpenEXR.File("b.exr", header_only=True) as header:
    read, told = [each.name() for each in file.parts], [each.name() for each in header.parts]
print("OpenEXR", version("OpenEXR"), "gives the parts", read, "of", told)
assert (read, told) == (["near"], ["near", "far"]), "no longer so"
END
