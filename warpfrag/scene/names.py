"""Names that scenes, files, fits and kernels share."""

from typing import Literal, get_args

Merge = Literal["none", "smooth", "order_independent", "exact"]
Mix = Literal["opacity", "average", "optical_depth"]
MERGES: tuple[Merge, ...] = get_args(Merge)
MIXES: tuple[Mix, ...] = get_args(Mix)

# Whose parameters are the camera's; no object may be named so.
CAMERA = "camera"
# The last parts of the names of an object's parameters, and of the poses that an object and the camera have.
PARAMETER_KEYS = ("thickness", "color", "opacity", "vertices")
POSE_KEYS = ("translation", "rotation")

# In scene units, or in multiples of the depth resolution P(z).
ThicknessUnit = Literal["scene", "P"]
