#!/bin/sh
# Pillow 12.0.0 cuts 16-bit colours of a PNG to 8 bits without a word.
#
# A PNG of colour type 2 and depth 16 is opened in mode RGB, whose numbers have 8 bits: 0x1234 is
# read as 0x12. Grey images of 16 bits keep theirs (mode I;16). Nothing in the image tells that it
# was cut.
#
# Installs pillow==12.0.0, pypng==0.20220715.0 in a temporary folder; exits with 0 while this is so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pillow==12.0.0 pypng==0.20220715.0
cd "$folder"
"$folder/venv/bin/python" - <<'END'
import warnings
import PIL, png
from PIL import Image
warnings.simplefilter("error")
with open("a.png", "wb") as file:
    png.Writer(1, 1, bitdepth=16, greyscale=False).write(file, [[0x1234, 0x1235, 0x12FF]])
with Image.open("a.png") as image:
    mode, pixel = image.mode, image.getpixel((0, 0))
print("Pillow", PIL.__version__, "gives", mode, pixel, "for 0x1234, 0x1235, 0x12ff")
assert (mode, pixel) == ("RGB", (0x12, 0x12, 0x12)), "no longer cut"
END
