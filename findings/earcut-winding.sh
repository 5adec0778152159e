#!/bin/sh
# mapbox-earcut 2.1.0 gives triangles of one sense of turning, whichever way the polygon runs.
#
# The same concave polygon, given counter-clockwise and clockwise, gives triangles that run the same
# way both times. Taken as they are, the faces of one of two neighbouring polygons look inwards.
#
# Installs mapbox-earcut==2.1.0, numpy==2.3.5 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mapbox-earcut==2.1.0 numpy==2.3.5
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import mapbox_earcut
import numpy as np
from importlib.metadata import version
points = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=np.float64)
senses = []
for ring in (points, points[::-1].copy()):
    triangles = mapbox_earcut.triangulate_float64(ring, np.array([len(ring)], dtype=np.uint32)).reshape(-1, 3)
    a, b, c = ring[triangles].transpose(1, 0, 2)
    areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    senses.append(sorted(set(np.sign(areas).tolist())))
print("mapbox-earcut", version("mapbox-earcut"), "gives the signs", senses, "for a polygon and its reverse")
assert senses[0] == senses[1], "no longer so"
END
