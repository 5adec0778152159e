"""What a slot of a k-buffer sums up over its members for the way back, and what each member gets of the gradient.

With rest_i = prod (1 - A_j) over the others, and S_i = A_i for fresh fragments:

    C = q A/S:   dC/dC_i = A/S,   dA/dA_i = rest_i,   dS/dA_i = 1
                 dC/dA_i = q (rest_i - A/S)/S = q ((S - A)/S - (1 - rest_i))/S

S - A = sum A_i (opacity of those before i) is summed up as it stands, for at small opacities the difference would have
lost all digits. All of this is in double precision: it is little work, and products of many transmittances are small.
"""

from typing import Any

import warp as wp

from warpfrag.storage.slots import DROPPED, OWNS_SLOT

wp.set_module_options({"enable_backward": False})

ONE = wp.constant(wp.float64(1.0))
ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class SlotSums:
    """Sums over the members of a slot: of colour times weight, opacity, S - A, S; prod (1 - A) of those below 1.

    `opaque`: number of the others; `back`, `front`: fragments that reach farthest back and front.
    """

    color: wp.vec3d
    opacity: wp.float64
    excess: wp.float64
    opacity_sum: wp.float64
    through: wp.float64
    opaque: wp.int32
    back: wp.int32
    front: wp.int32


@wp.func(inline=True)
def layer_of(parent: wp.array[wp.int32], number: int):
    """Return the layer that a fragment ended in, or -1 if it was dropped; shortens the paths of those that follow."""
    place = int(number)
    above = int(parent[place])
    while above >= 0:
        following = parent[above]
        if following >= 0:
            parent[place] = following
        place = above
        above = following
    layer = int(-1)
    if above != DROPPED:
        layer = OWNS_SLOT - above
    return layer


@wp.func(inline=True)
def load_member(lists: Any, fragment: int):
    """Return colour and opacity, opacity sum and weight of a fragment, in double precision."""
    rgba = wp.vec4d(lists.rgba[fragment])
    s = rgba[3]
    weight = ONE
    if lists.opacity_sum.shape[0] > 0:
        s = wp.float64(lists.opacity_sum[fragment])
        if rgba[3] > ZERO:
            weight = s / rgba[3]
    return rgba, s, weight


@wp.func(inline=True)
def front_of(lists: Any, fragment: int, merging: int):
    """Return where a fragment begins, in the precision in which it was streamed."""
    front = lists.depth[fragment]
    if merging != 0:
        front = front - lists.thickness[fragment]
    return front


@wp.func(inline=True)
def with_member(sums: SlotSums, lists: Any, fragment: int, merging: int):
    """Return the sums with one member more."""
    rgba, s, weight = load_member(lists, fragment)
    more = SlotSums()
    more.color = sums.color + weight * wp.vec3d(rgba[0], rgba[1], rgba[2])
    more.opacity = sums.opacity + (ONE - sums.opacity) * rgba[3]
    more.excess = sums.excess + sums.opacity * rgba[3]
    more.opacity_sum = sums.opacity_sum + s
    more.through = sums.through
    more.opaque = sums.opaque
    if rgba[3] < ONE:
        more.through = sums.through * (ONE - rgba[3])
    else:
        more.opaque = sums.opaque + 1
    more.back = sums.back
    if sums.back < 0 or lists.depth[fragment] > lists.depth[sums.back]:
        more.back = fragment
    more.front = sums.front
    if sums.front < 0 or front_of(lists, fragment, merging) < front_of(lists, sums.front, merging):
        more.front = fragment
    return more


@wp.func(inline=True)
def no_sums():
    """Return the sums over nothing."""
    sums = SlotSums()
    sums.through = ONE
    sums.back = -1
    sums.front = -1
    return sums


@wp.func(inline=True)
def rest_of(sums: SlotSums, opacity: wp.float64):
    """Return the transmittance of all members but one of this opacity, and 1 minus that."""
    rest = ZERO
    if opacity < ONE:
        if sums.opaque == 0:
            rest = sums.through / (ONE - opacity)
            return rest, wp.max(sums.opacity - opacity, ZERO) / (ONE - opacity)
    elif sums.opaque == 1:
        rest = sums.through
    return rest, ONE - rest


@wp.func(inline=True)
def member_adjoint(sums: SlotSums, g: wp.vec4d, g_sum: wp.float64, lists: Any, fragment: int):
    """Return a member's gradients in colour and opacity and in the opacity sum, given those of the layer."""
    rgba, s, weight = load_member(lists, fragment)
    g_color = wp.vec3d(g[0], g[1], g[2])
    rest, rest_opacity = rest_of(sums, rgba[3])
    g_opacity = g[3] * rest
    g_own_sum = g_sum
    scale = ONE
    if sums.opacity_sum > ZERO and sums.opacity > ZERO:
        scale = sums.opacity / sums.opacity_sum
        along = wp.dot(g_color, sums.color)
        if lists.opacity_sum.shape[0] > 0:
            g_opacity += along * rest / sums.opacity_sum
            g_own_sum -= along * scale / sums.opacity_sum
            if rgba[3] > ZERO:
                own = scale * wp.dot(g_color, wp.vec3d(rgba[0], rgba[1], rgba[2])) / rgba[3]
                g_own_sum += own
                g_opacity -= own * weight
        else:
            g_opacity += along * (sums.excess / sums.opacity_sum - rest_opacity) / sums.opacity_sum
    if lists.opacity_sum.shape[0] == 0:
        g_opacity += g_sum
    g_color = scale * weight * g_color
    return wp.vec4d(g_color[0], g_color[1], g_color[2], g_opacity), g_own_sum
