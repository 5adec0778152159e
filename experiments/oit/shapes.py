"""Shapes of high depth complexity, made from numbers alone: hair, machine parts, a floor of points, text."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from warpfrag.shapes.mesh import Mesh, smooth_normals, split_faces
from warpfrag.shapes.primitives import cube, sphere
from warpfrag.shapes.surfels import PointSet

TURN = 2.0 * np.pi


def hair_ball(strands: int = 100_000, segments: int = 14, width: float = 0.006, seed: int = 1) -> Mesh:
    """Build a ball of curly hair of radius 1 around a bald core: flat strips that grow outwards and taper.

    Args:
        strands: number of strips.
        segments: pieces of each, two triangles apiece.
        width: width at the root [scene units].
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, 1.0, segments + 1)[None, :, None]

    def directions() -> np.ndarray:
        vectors = rng.normal(size=(strands, 1, 3))
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    root, bend = directions(), directions()
    first = np.cross(root, directions())
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(root, first)
    radius = 0.1 + 0.9 * rng.uniform(0.7, 1.0, (strands, 1, 1)) * along
    turns, phase = rng.uniform(0.5, 2.0, (strands, 1, 1)), rng.uniform(0.0, TURN, (strands, 1, 1))
    curl = (0.2 + along) * rng.uniform(0.04, 0.2, (strands, 1, 1))
    angle = phase + TURN * turns * along
    middle = radius * root + curl * (np.cos(angle) * first + np.sin(angle) * second) + 0.35 * along**2 * bend
    # Strands that bend beyond the ball are folded back onto it.
    middle *= radius / np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), radius)
    tangent = np.gradient(middle, axis=1)
    across = np.cross(tangent, directions())
    across *= 0.5 * width * (1.0 - 0.7 * along) / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    vertices = np.stack([middle - across, middle + across], axis=2)
    at = 2 * np.arange(segments)[:, None]
    strip = np.concatenate([at + np.array([0, 1, 3]), at + np.array([0, 3, 2])], axis=1).reshape(-1, 3)
    faces = 2 * (segments + 1) * np.arange(strands)[:, None, None] + strip
    normals = np.repeat(np.cross(tangent, across)[:, :, None], 2, axis=2)
    dark = np.array([[0.20, 0.02, 0.03], [0.03, 0.08, 0.25], [0.02, 0.16, 0.06]])
    light = np.array([[1.00, 0.42, 0.05], [0.30, 0.75, 1.00], [0.75, 0.90, 0.15]])
    # Tufts of one colour that show which of them are in front.
    tuft = np.argmax(np.stack([np.sin(5.0 * root[:, 0] @ axis) for axis in rng.normal(size=(3, 3))]), axis=0)
    color = dark[tuft][:, None, :] * (1.0 - along) + light[tuft][:, None, :] * along
    color = np.repeat(color[:, :, None], 2, axis=2)
    return Mesh(
        vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), normals.reshape(-1, 3), color.reshape(-1, 3)
    )


def prism(outline: np.ndarray, height: float, hole: np.ndarray | None = None) -> Mesh:
    """Build a flat-shaded prism along z over a star-shaped outline (n, 2), or a hole of as many corners in it."""
    count = len(outline)
    inner = np.zeros((count, 2)) if hole is None else hole
    rings = [
        np.column_stack([ring, np.full(count, z)]) for ring in (outline, inner) for z in (-height / 2.0, height / 2.0)
    ]
    here = np.arange(count)
    ahead = (here + 1) % count
    low, high, inner_low, inner_high = (count * ring for ring in range(4))

    def band(one: int, other: int) -> np.ndarray:
        quads = np.stack([one + here, one + ahead, other + ahead, one + here, other + ahead, other + here], axis=-1)
        return quads.reshape(-1, 3)

    bands = [band(low, high), band(high, inner_high), band(inner_low, low)]
    if hole is not None:
        bands.append(band(inner_high, inner_low))
    faces = np.concatenate(bands)
    vertices = np.concatenate(rings)
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Without a hole the inner ring is one point, and half of the caps' triangles are empty.
    faces = faces[np.einsum("ij,ij->i", area, area) > 0.0]
    return split_faces(Mesh(vertices, faces.astype(np.int32)))


def circle(radius: float, corners: int) -> np.ndarray:
    """Return the corners of a regular polygon, (corners, 2)."""
    angle = TURN * np.arange(corners) / corners
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def gear(teeth: int, radius: float, thickness: float, bore: float) -> Mesh:
    """Build a gear about z with trapezoid teeth."""
    depth = 3.0 * radius / teeth
    profile = np.array([radius - 0.5 * depth, radius + 0.5 * depth, radius + 0.5 * depth, radius - 0.5 * depth])
    angle = TURN * (np.arange(4 * teeth) + np.tile([0.0, 0.15, -0.15, 0.0], teeth)) / (4 * teeth)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return prism(np.tile(profile, teeth)[:, None] * direction, thickness, bore * direction)


def bolt(radius: float, length: float) -> Mesh:
    """Build a bolt along z with a hexagonal head and a washer at z = 0; its shaft points to −z."""
    head, washer = prism(circle(1.9 * radius, 6), 1.3 * radius), prism(circle(2.3 * radius, 20), 0.3 * radius)
    shaft = prism(circle(radius, 12), length)
    return joined(
        [moved(head, [0, 0, 0.95 * radius]), moved(washer, [0, 0, 0.15 * radius]), moved(shaft, [0, 0, -0.5 * length])]
    )


def pipe(path: np.ndarray, radius: float, wall: float = 0.15, segments: int = 20) -> Mesh:
    """Build a pipe along a path (n, 3): an outer and an inner wall, open at its ends."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    sides = []
    for direction in tangent:
        # Carried along without a twist.
        side = side - direction * (side @ direction)
        side = side / np.linalg.norm(side)
        sides.append(side)
    frame = np.stack([np.array(sides), np.cross(tangent, np.array(sides))], axis=1)
    rim = np.einsum("sk,nkd->nsd", circle(1.0, segments), frame)
    here = np.arange(segments)
    ahead = (here + 1) % segments
    at = segments * np.arange(len(path) - 1)[:, None]
    quads = np.stack(
        [at + here, at + ahead, at + segments + ahead, at + here, at + segments + ahead, at + segments + here]
    )
    faces = np.moveaxis(quads, 0, -1).reshape(-1, 3).astype(np.int32)
    walls = []
    for size in (radius, (1.0 - wall) * radius):
        vertices = (path[:, None] + size * rim).reshape(-1, 3)
        walls.append(Mesh(vertices, faces, smooth_normals(vertices, faces)))
    return joined(walls)


def rounded(corners: Sequence[Sequence[float]], radius: float, steps: int = 8) -> np.ndarray:
    """Return a path through corners (n, 3) that rounds them off by quadratic curves."""
    points = np.asarray(corners, dtype=float)
    path = [points[:1]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        start = corner + radius * (before - corner) / np.linalg.norm(before - corner)
        end = corner + radius * (after - corner) / np.linalg.norm(after - corner)
        s = np.linspace(0.0, 1.0, steps + 1)[:, None]
        path.append((1 - s) ** 2 * start + 2 * s * (1 - s) * corner + s**2 * end)
    return np.concatenate([*path, points[-1:]])


def machine() -> Iterator[tuple[str, Mesh, tuple[float, float, float]]]:
    """Yield the parts of an engine with its gear train, over 400: name, mesh, colour; y is up, length along x."""
    steel, brass, red, blue, green, dark = (
        (0.55, 0.58, 0.62),
        (0.85, 0.55, 0.12),
        (0.75, 0.06, 0.04),
        (0.05, 0.16, 0.60),
        (0.06, 0.45, 0.16),
        (0.10, 0.11, 0.13),
    )
    upright = turned([1, 0, 0], -90)
    lengthwise = turned([0, 1, 0], 90)
    yield "bed", moved(cube((3.4, 0.12, 1.5)), [0, -0.86, 0]), dark
    yield "crankcase", moved(cube((2.7, 0.5, 0.9)), [-0.1, -0.5, 0]), blue
    yield "crankcase inside", moved(cube((2.6, 0.42, 0.8)), [-0.1, -0.5, 0]), blue
    yield "crankshaft", moved(placed(prism(circle(0.08, 32), 3.3), lengthwise), [0, -0.5, 0]), steel
    yield "camshaft", moved(placed(prism(circle(0.05, 24), 3.1), lengthwise), [0.05, -0.05, 0.52]), steel
    ring = circle(1.0, 40)
    for row, z in enumerate((-0.3, 0.3)):
        for number, x in enumerate((-1.2, -0.65, -0.1, 0.45)):
            name = f"cylinder {row}.{number}"
            barrel = placed(prism(0.21 * ring, 0.9, 0.18 * ring), upright)
            yield f"{name} barrel", moved(barrel, [x, 0.2, z]), steel
            for fin in range(13):
                plate = placed(prism(0.27 * ring, 0.02, 0.21 * ring), upright)
                yield f"{name} fin {fin}", moved(plate, [x, -0.16 + 0.06 * fin, z]), steel
            stroke = 0.16 * np.sin(1.9 * number + np.pi * row)
            yield f"{name} piston", moved(placed(prism(0.175 * ring, 0.2), upright), [x, 0.25 + stroke, z]), brass
            rod = pipe(np.array([[x, -0.5, 0.3 * z], [x, 0.18 + stroke, z]]), 0.035)
            yield f"{name} rod", rod, red
            yield f"{name} crank", moved(placed(prism(circle(0.2, 32), 0.06), lengthwise), [x + 0.07, -0.5, 0]), dark
            yield f"{name} head", moved(placed(prism(circle(0.25, 6), 0.12), upright), [x, 0.72, z]), green
            for valve, shift in enumerate((-0.08, 0.08)):
                stem = placed(prism(circle(0.014, 10), 0.36), upright)
                yield f"{name} valve {valve}", moved(stem, [x + shift, 0.9, z]), brass
                yield f"{name} spring {valve}", spring([x + shift, 0.8, z], 0.045, 0.24), red
            for corner in range(4):
                dx, dz = 0.22 * np.cos(TURN * (corner + 0.5) / 4), 0.22 * np.sin(TURN * (corner + 0.5) / 4)
                yield f"{name} bolt {corner}", moved(placed(bolt(0.022, 0.75), upright), [x + dx, 0.78, z + dz]), dark
            outlet = rounded([[x, 0.6, z], [x, 0.6, 2.4 * z], [x, -0.3, 2.4 * z], [1.2, -0.3, 2.4 * z]], 0.12)
            yield f"{name} exhaust", pipe(outlet, 0.055), brass
    for row, z in enumerate((-0.72, 0.72)):
        yield f"manifold {row}", pipe(np.array([[-1.5, -0.3, z], [0.2, -0.3, z], [1.65, -0.3, z]]), 0.1), brass
        yield f"rocker cover {row}", moved(cube((2.3, 0.26, 0.36)), [-0.37, 0.98, 0.42 * z]), red
        yield f"rocker cover inside {row}", moved(cube((2.24, 0.2, 0.3)), [-0.37, 0.98, 0.42 * z]), red
        for number in range(24):
            x, side = -1.45 + 0.19 * (number // 2), 0.15 * (-1) ** number
            yield (
                f"cover bolt {row}.{number}",
                moved(placed(bolt(0.018, 0.12), upright), [x, 1.11, 0.42 * z + side]),
                dark,
            )
    for number in range(40):
        x, side = -1.6 + 0.168 * (number // 2), 0.66 * (-1) ** number
        yield f"bed bolt {number}", moved(placed(bolt(0.03, 0.14), upright), [x, -0.79, side]), steel
    train = [(0.0, -0.5, 30, 0.34), (0.42, -0.06, 22, 0.25), (-0.42, -0.06, 22, 0.25), (0.36, 0.45, 22, 0.25)]
    train += [(-0.36, 0.45, 22, 0.25), (0.0, 0.0, 16, 0.18), (0.0, 0.82, 26, 0.29)]
    for number, (z, y, teeth, radius) in enumerate(train):
        for side, x in enumerate((1.0, 1.14, 1.28)):
            wheel = placed(gear(teeth, radius, 0.09, 0.3 * radius), lengthwise)
            yield f"gear {number}.{side}", moved(wheel, [x, y, z]), (brass, steel, green)[(number + side) % 3]
        yield (
            f"gear shaft {number}",
            moved(placed(prism(circle(0.28 * radius, 24), 0.6), lengthwise), [1.14, y, z]),
            steel,
        )
        yield (
            f"bearing {number}",
            moved(placed(prism(circle(0.5 * radius, 32), 0.05, circle(0.28 * radius, 32)), lengthwise), [1.46, y, z]),
            red,
        )
        for ball in range(9):
            at = 0.39 * radius * np.array([np.cos(TURN * ball / 9), np.sin(TURN * ball / 9)])
            yield f"ball {number}.{ball}", moved(sphere(0.03, 16), [1.46, y + at[0], z + at[1]]), steel
    for name, size in (("gear case", (0.62, 1.75, 1.4)), ("gear case inside", (0.56, 1.69, 1.34))):
        yield name, moved(cube(size), [1.16, 0.12, 0]), blue
    for number in range(32):
        angle = TURN * number / 32
        y, z = np.clip(1.3 * np.sin(angle), -1, 1) * 0.8 + 0.12, np.clip(1.3 * np.cos(angle), -1, 1) * 0.64
        yield f"case bolt {number}", moved(placed(bolt(0.022, 0.1), lengthwise), [1.48, y, z]), dark
    for plate in range(14):
        yield (
            f"radiator {plate}",
            moved(cube((0.012, 1.0, 1.1)), [-1.66 - 0.035 * plate, 0.2, 0]),
            (steel, blue)[plate % 2],
        )
    for number in range(10):
        y, z = 0.35 + 0.09 * number, -0.45 + 0.1 * number
        path = rounded([[-1.6, y, z], [-2.3, y, z], [-2.3, -0.75, z], [1.6, -0.75, z]], 0.15)
        yield f"fuel line {number}", pipe(path, 0.025), (green, red, blue)[number % 3]


def spring(foot: Sequence[float], radius: float, height: float) -> Mesh:
    """Build a spring of 6 turns that stands along y."""
    s = np.linspace(0.0, 1.0, 97)
    path = np.stack([radius * np.cos(6 * TURN * s), height * s, radius * np.sin(6 * TURN * s)], axis=-1)
    return pipe(path + np.asarray(foot), 0.008, segments=6)


def floor_points(count: int = 60_000, seed: int = 2) -> PointSet:
    """Scatter coloured points over a tiled floor with bumps and a row of boxes and balls on it, as a scanner would."""
    rng = np.random.default_rng(seed)
    parts: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []

    def spread(area: float) -> int:
        return max(round(count * area / 20.0), 8)

    # The floor, 4 × 2.6, with waves.
    n = spread(4.0 * 2.6)
    x, z = rng.uniform(-2.0, 2.0, n), rng.uniform(-1.3, 1.3, n)
    points = np.stack([x, _height(x, z), z], axis=-1)
    step = 1e-4
    slope_x = (_height(x + step, z) - _height(x - step, z)) / (2 * step)
    slope_z = (_height(x, z + step) - _height(x, z - step)) / (2 * step)
    normals = np.stack([-slope_x, np.ones(n), -slope_z], axis=-1)
    tile = (np.floor(x / 0.4) + np.floor(z / 0.4)) % 2
    color = np.where(tile[:, None] > 0, [0.72, 0.62, 0.45], [0.22, 0.25, 0.30])
    parts.append((0.0, points, normals, color))
    palette = np.array([[0.75, 0.1, 0.07], [0.1, 0.35, 0.7], [0.12, 0.5, 0.2], [0.85, 0.55, 0.08], [0.45, 0.12, 0.5]])
    for number, middle in enumerate(np.linspace(-1.5, 1.5, 7)):
        size = np.array([0.24, 0.34 + 0.1 * (number % 3), 0.5])
        at = np.array([middle, 0.5 * size[1] + 0.03, 0.5 * np.sin(2.3 * number)])
        if number % 3 == 2:
            n = spread(TURN * 2 * 0.28**2)
            normals = rng.normal(size=(n, 3))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            points = [at[0], 0.3, at[2]] + 0.28 * normals
        else:
            points, normals = _box_points(rng, size, spread)
            points = points + at
        color = palette[number % len(palette)] * np.ones((len(points), 3))
        parts.append((middle, points, normals, color))
    points, normals, color = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    color = np.clip(color * rng.uniform(0.8, 1.2, (len(color), 1)), 0.0, 1.0)
    points = points + rng.normal(scale=0.0015, size=points.shape)
    order = rng.permutation(len(points))
    return PointSet(points[order], normals[order], color[order])


def _height(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    bumps = 0.09 * np.exp(-((np.mod(x + 0.25, 0.9) - 0.45) ** 2 + (np.mod(z + 0.1, 0.9) - 0.45) ** 2) / 0.02)
    return bumps + 0.015 * np.sin(3.0 * x) * np.cos(4.0 * z)


def _box_points(rng: np.random.Generator, size: np.ndarray, spread) -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        for way in (-0.5, 0.5):
            n = spread(size[one] * size[other])
            part = rng.uniform(-0.5, 0.5, (n, 3))
            part[:, axis] = way
            points.append(part * size)
            normals.append(np.sign(way) * np.tile(np.eye(3)[axis], (n, 1)))
    return np.concatenate(points), np.concatenate(normals)


def sample_points(mesh: Mesh, count: int, seed: int = 3) -> PointSet:
    """Scatter points evenly over a mesh, with the normals of its faces."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(area, axis=1)
    face = np.searchsorted(np.cumsum(size), rng.uniform(0.0, size.sum(), count))
    face = np.minimum(face, len(size) - 1)
    u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    weight = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=-1)
    return PointSet(np.einsum("nk,nkd->nd", weight, corners[face]), area[face] / size[face, None])


def text(words: str, height: float) -> Mesh:
    """Build text in the x–y plane, centred on the origin, its letters as high as their capitals' `height`.

    The outlines are cut into trapezoids between the heights of all their corners.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    polygons = TextPath((0, 0), words, size=1.0, prop=FontProperties(weight="bold")).to_polygons()
    edges = np.concatenate([np.stack([polygon[:-1], polygon[1:]], axis=1) for polygon in polygons])
    edges = edges[edges[:, 0, 1] != edges[:, 1, 1]]
    edges = np.where(edges[:, :1, 1:] < edges[:, 1:, 1:], edges, edges[:, ::-1])
    levels = np.unique(edges[:, :, 1])
    quads = []
    for low, high in pairwise(levels):
        spanning = edges[(edges[:, 0, 1] <= low) & (edges[:, 1, 1] >= high)]
        start, way = spanning[:, 0], spanning[:, 1] - spanning[:, 0]
        at = [start[:, 0] + way[:, 0] * (y - start[:, 1]) / way[:, 1] for y in (low, high)]
        order = np.argsort(at[0] + at[1])
        for left, right in order.reshape(-1, 2):
            quads.append([[at[0][left], low], [at[0][right], low], [at[1][right], high], [at[1][left], high]])
    corners = np.array(quads).reshape(-1, 2)
    capital = TextPath((0, 0), "H", size=1.0, prop=FontProperties(weight="bold")).get_extents()
    corners = (corners - [(corners[:, 0].min() + corners[:, 0].max()) / 2.0, capital.height / 2.0]) * (
        height / capital.height
    )
    vertices = np.column_stack([corners, np.zeros(len(corners))])
    faces = (4 * np.arange(len(quads))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(vertices, faces.astype(np.int32), np.tile([0.0, 0.0, 1.0], (len(vertices), 1)))


def turned(axis: Sequence[float], degrees: float) -> np.ndarray:
    """Return the rotation about an axis of length 1, (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def placed(mesh: Mesh, rotation: np.ndarray) -> Mesh:
    """Return a mesh turned about the origin."""
    assert mesh.normals is not None
    return replace(mesh, vertices=mesh.vertices @ rotation.T, normals=mesh.normals @ rotation.T)


def moved(mesh: Mesh, shift: Sequence[float]) -> Mesh:
    """Return a mesh moved."""
    return replace(mesh, vertices=mesh.vertices + np.asarray(shift, dtype=float))


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Put meshes with normals and without colours into one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + np.int32(at) for part, at in zip(parts, first, strict=False)]),
        np.concatenate([part.normals for part in parts if part.normals is not None]),
    )
