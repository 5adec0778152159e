#!/bin/sh
# OpenEXR 3.5.3 (Python) does not open files with a deepImageState, an attribute of OpenEXR's own.
#
# It tells whether deep samples are sorted and free of overlap (OpenEXR's DeepImageStateAttribute);
# other programs write it, and OpenEXR's own test images 11, 42 and 64.deep.exr have it. Even the
# header cannot be had. Here a text is made one: the attribute's value has the same length.
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
pixels[0, 0] = np.ones(2, np.float32)
header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, "state": "x" * 9}
with OpenEXR.File(header, {"Z": pixels}) as file:
    file.write("a.exr")
with open("a.exr", "rb") as file:
    data = file.read()
text = b"state\0string\0" + (9).to_bytes(4, "little") + b"x" * 9
state = b"state\0deepImageState\0" + (1).to_bytes(4, "little") + b"\3"
assert data.count(text) == 1 and len(text) == len(state)
with open("a.exr", "wb") as file:
    file.write(data.replace(text, state))
try:
    OpenEXR.File("a.exr", header_only=True)
    told = ""
except Exception as error:
    told = str(error)
print("OpenEXR", version("OpenEXR"), "says", repr(told))
assert "deepImageState" in told, "opened"
END
