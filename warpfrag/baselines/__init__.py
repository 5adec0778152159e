"""Other methods for order-independent transparency, to compare with: each a function from fragments to an image.

They are here to be right and readable, not quick. All of them take a fragment as a surface at its depth: none knows a
thickness. All are exact for a pixel with one fragment (moments up to their bias) and leave empty pixels transparent.
"""

from warpfrag.baselines.adaptive import adaptive_transparency
from warpfrag.baselines.hybrid import hybrid_transparency
from warpfrag.baselines.moments import moment_based, moment_transmittance
from warpfrag.baselines.multi_layer import multi_layer_alpha_blending
from warpfrag.baselines.stochastic import stochastic_transparency
from warpfrag.baselines.weighted import weighted_blended

__all__ = [
    "adaptive_transparency",
    "hybrid_transparency",
    "moment_based",
    "moment_transmittance",
    "multi_layer_alpha_blending",
    "stochastic_transparency",
    "weighted_blended",
]
