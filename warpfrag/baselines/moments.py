"""Moment-based order-independent transparency with power moments (Münstermann et al., PACMCGIT 1(1), 2018).

The absorbance of a pixel, a(z) = -log T(z), is a step at every fragment. Its moments are additive, in any order:

    a_i = min(-log(1 - A_i), 10),   b_0 = sum_i a_i,   b_k = sum_i a_i z_i^k / b_0     (k = 1 ... n; z_i in -1 ... 1)

From them the absorbance up to a depth z is bounded (algorithm 2 of the paper): among all distributions on m + 1 = n/2 + 1
points with these moments there is one, the canonical one, with a point at z itself. With its points z_j, weights w_j and
the weight w at z the absorbance lies between what is before z and that plus w; the overestimation beta picks a value:

    T(z) = exp(-b_0 (sum_{z_j < z} w_j + beta w))

    C = A sum_i C_i T(z_i) / sum_i A_i T(z_i),   A = 1 - exp(-b_0)

The paper finds the points as roots of a polynomial. Here they are eigenvalues, which needs no formula for each degree
and has no division by its leading coefficient: with the m x m Hankel matrices of the moments with respect to z

    N_ij = b_{i+j+1} - z b_{i+j},   G_ij = b_{i+j+2} - 2 z b_{i+j+1} + z^2 b_{i+j} = (L L^T)_ij

the eigenvalues of L^-1 N L^-T are 1/(z_j - z), and with the first components q_j of its eigenvectors, of length one, the
weights are w_j = (L_00 q_j / (z_j - z))^2; a point that goes to infinity is the eigenvalue 0. (The canonical points other
than z are the Gauss points of the measure (z' - z)^2 a, of which G and N are the moments.)

Differentiable in colour, opacity and depth; the depth range is held fixed. Computed in float64 throughout.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from warpfrag.baselines.inputs import array_module, check_choice_of, exact_image, owners, range_of_depths, ratio, sum_pixels
from warpfrag.fragments import Fragments

# Bias towards moments b* that are safely inside the space of moments (table of the paper, single precision).
BIAS = {4: 5e-7, 6: 5e-6, 8: 5e-5}
BIAS_TARGET = {
    4: (0.0, 0.375, 0.0, 0.375),
    6: (0.0, 0.48, 0.0, 0.451, 0.0, 0.45),
    8: (0.0, 0.75, 0.0, 0.676666667, 0.0, 0.63, 0.0, 0.60030303),
}
