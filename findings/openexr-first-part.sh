#!/bin/sh
# OpenEXR 3.4.2 (Python): channels() of a file of several parts are those of the first part alone.
#
# A multi-part file whose first part is depth and whose second has the colours looks like one
# without colours: channels() takes the number of a part, which is 0 if nobody says so, and the
# header does not tell that there are others.
#
# Installs OpenEXR==3.4.2, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check OpenEXR==3.4.2 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import OpenEXR
import numpy as np
from importlib.metadata import version
values = np.full((2, 3), 0.25, np.float32)
part = lambda name, channels: OpenEXR.Part({"type": OpenEXR.scanlineimage, "name": name}, channels, name)
with OpenEXR.File([part("depth", {"Z": values}), part("rgb", dict.fromkeys("RGB", values))]) as file:
    file.write("a.exr")
with OpenEXR.File("a.exr", separate_channels=True) as file:
    first, second = sorted(file.channels()), sorted(file.channels(1))
print("OpenEXR", version("OpenEXR"), "gives", first, "and, asked for part 1,", second)
assert (first, second) == (["Z"], ["B", "G", "R"]), "no longer so"
END
