"""A scene as an image: capture, resolve and composite, in bands of rows where memory is short."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.kinds import dtype_name, kind_of
from warpfrag.capture.bounded import kbuffer_of_surfaces
from warpfrag.capture.coverage import Coverage, store_coverage
from warpfrag.capture.memory import Budget, CaptureSizes, split_rows
from warpfrag.capture.surfaces import CameraSurfaces, SurfaceTables, check_scene, surfaces_of
from warpfrag.composite import composite
from warpfrag.errors import check_choice, check_number, is_number
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.resolve.options import check_options
from warpfrag.scene.camera import Camera
from warpfrag.scene.names import Merge, Mix
from warpfrag.scene.parameters import Bounds, bounded_beta
from warpfrag.scene.scene import Scene
from warpfrag.scene.visibility import warn_if_empty
from warpfrag.storage.into_slots import check_kbuffer, kbuffer_bytes
from warpfrag.storage.kbuffer import kbuffer
from warpfrag.storage.method import count_fragments

Resolve = Literal["sorted", "kbuffer"]


@dataclass(frozen=True, eq=False)
class _Counted:
    """How many fragments each pixel, (P,), and each row has, of which there is no room for all at once."""

    counts: wp.array
    row_counts: np.ndarray


class Renderer:
    """Images of one scene from one camera, for one set of parameter values after the other.

    What each pixel sees is kept for as long as no vertex moves in camera space: an image for another colour, opacity,
    thickness or beta is then only shaded and composited. Every image, and its gradient, is that of a new renderer, to
    the bit.

    Args:
        scene: what to render.
        camera: where from; default the scene's.
        resolve: "sorted" sorts all fragments of a pixel; "kbuffer" streams them in order of submission into slots, see
            `kbuffer`.
        beta: see `resolve`; default `parameters["beta"]`, or else the scene's. A k-buffer has none.
        max_layers: see `resolve`, or the slots of a k-buffer; default the scene's `layers`.
        merge: see `resolve` or `kbuffer`; default the scene's.
        mix: see `resolve`; default the scene's. A k-buffer has none.
        background: whether to composite over the scene's background.
        bounds: see `render`.
        memory_limit: see `render`.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.

    Example:
        >>> renderer = wf.Renderer(wf.load_scene("scenes/three_spheres.toml"))
        >>> [renderer.image({"thickness": thickness}).shape for thickness in (0.1, 0.2)]
        [(512, 512, 4), (512, 512, 4)]
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera | None = None,
        *,
        resolve: Resolve = "sorted",
        beta: Any = None,
        max_layers: int | None = None,
        merge: Merge | None = None,
        mix: Mix | None = None,
        background: bool = True,
        bounds: Bounds = "clamp",
        memory_limit: float | None = None,
    ):
        self.camera = check_scene(scene, camera)
        if is_number(beta):
            # Nobody optimises a plain number: out of its range it is a mistake.
            check_number("beta", beta, 0.0, 1.0)
        self.scene, self.resolve, self.beta = scene, resolve, beta
        self.max_layers = scene.layers if max_layers is None else max_layers
        self.merge, self.mix = merge or scene.merge, mix or scene.mix
        self.background, self.bounds, self.memory_limit = background, bounds, memory_limit
        check_choice("resolve", resolve, get_args(Resolve))
        if resolve == "kbuffer":
            check_kbuffer(self.max_layers, self.merge, "mix")
        else:
            check_options(self.merge, self.mix, self.max_layers)
        self.max_layers = int(self.max_layers)
        self._tables: SurfaceTables | None = None
        self._coverage: Coverage | None = None
        self._sizes: CaptureSizes | None = None

    @property
    def coverage(self) -> Coverage:
        """What each pixel saw the last time, or else sees in the scene as it is.

        Raises:
            MemoryError: it would take more memory than allowed.
        """
        if self._coverage is None:
            surfaces = self._surfaces({})
            with surfaces.in_order():
                self._seen(surfaces)
        assert self._coverage is not None
        return self._coverage

    def fragments(self, parameters: Mapping[str, Any] | None = None) -> Fragments:
        """Return the fragments for parameter values, as `capture` does: sorted, or for a k-buffer as submitted.

        Raises:
            TypeError: a value is of the wrong type.
            ValueError: a value is out of its range.
            MemoryError: they would take more memory than allowed.
        """
        surfaces = self._surfaces(parameters or {})
        with surfaces.in_order():
            return self._seen(surfaces).shade_surfaces(surfaces, moved=False)

    def image(self, parameters: Mapping[str, Any] | None = None) -> Any:
        """Return the image for parameter values; see `render`, also for what is raised."""
        values = dict(parameters or {})
        if self.beta is not None:
            # As a parameter it has its say in the kind and precision of the image.
            values["beta"] = self.beta
        kind = kind_of(values.get("beta"))
        if kind is not None and kind.name == "warp":
            raise TypeError("beta: got a wp.array, expected a number, a NumPy array or a torch.Tensor")
        surfaces = self._surfaces(values)
        beta = bounded_beta(_beta_like(values.get("beta", self.scene.beta), surfaces), self.bounds)
        with surfaces.in_order():
            found = self._cover(surfaces)
            if isinstance(found, Coverage):
                warn_if_empty(found.count, self.scene, self.camera)
                return self._composite(found, surfaces, beta)
            if self.resolve == "sorted":
                return self._image_in_bands(surfaces, found, beta)
            window, limit = Window.of(surfaces.camera), self.memory_limit
            layers = kbuffer_of_surfaces(surfaces, window, limit, slots=self.max_layers, merge=self.merge, tail="mix")
            return self._over_background(composite(layers))

    def _surfaces(self, parameters: Mapping[str, Any]) -> CameraSurfaces:
        surfaces = surfaces_of(self.scene, self.camera, parameters, self._tables, bounds=self.bounds)
        self._tables = surfaces.tables
        return surfaces

    def _seen(self, surfaces: CameraSurfaces) -> Coverage:
        found = self._cover(surfaces)
        if isinstance(found, Coverage):
            return found
        total = int(found.row_counts.sum())
        self._budget(surfaces).check(total, self._pixel_count, f"{total} fragments")
        raise AssertionError("what does not fit is refused")

    def _cover(self, surfaces: CameraSurfaces) -> Coverage | _Counted:
        """Return what each pixel sees, kept from the last time if that is the same, or why there is no room for it."""
        kept = self._coverage
        if kept is not None and kept.is_of(surfaces):
            if self._budget(surfaces).allows(kept.count, self._pixel_count):
                self._coverage = kept.to(surfaces.device)
                return self._coverage
            self._coverage = None
        triangles = surfaces.triangles(Window.of(surfaces.camera))
        self._sizes = CaptureSizes.of(triangles, surfaces)
        budget, counts = self._budget(surfaces), count_fragments(triangles)
        row_counts = counts.numpy().reshape(self.camera.shape).sum(axis=1, dtype=np.int64)
        if not budget.allows(int(row_counts.sum()), self._pixel_count):
            return _Counted(counts, row_counts)
        # The old one goes before the new one comes.
        self._coverage = kept = None
        self._coverage = store_coverage(
            self.scene, surfaces.camera, surfaces, triangles, counts, budget, sort=self.resolve == "sorted"
        )
        return self._coverage

    def _budget(self, surfaces: CameraSurfaces) -> Budget:
        assert self._sizes is not None
        layer = kbuffer_bytes(1, self.max_layers, surfaces.number) if self.resolve == "kbuffer" else 0
        return Budget.of(self._sizes, self.memory_limit, surfaces, image=True, layer=layer)

    def _composite(self, coverage: Coverage, surfaces: CameraSurfaces, beta: Any) -> Any:
        """Return the image of what surfaces look like where they are seen."""
        # Not held by a name: with the image there, the fragments may go.
        if self.resolve == "kbuffer":
            layers = kbuffer(coverage.shade_surfaces(surfaces, moved=False), self.max_layers, merge=self.merge)  # type: ignore[arg-type]
            return self._over_background(composite(layers))
        return self._over_background(
            composite(
                coverage.shade_surfaces(surfaces, moved=False),
                beta,
                max_layers=self.max_layers,
                merge=self.merge,
                mix=self.mix,
            )
        )

    def _over_background(self, image: Any) -> Any:
        return over_background(image, self.scene.background) if self.background else image

    @property
    def _pixel_count(self) -> int:
        return self.camera.shape[0] * self.camera.shape[1]

    def _image_in_bands(self, surfaces: CameraSurfaces, found: _Counted, beta: Any) -> Any:
        budget, counts, width = self._budget(surfaces), found.counts, self.camera.width
        row_bytes = budget.needed(found.row_counts, width)
        bands = split_rows(found.row_counts, row_bytes, budget.allowed, budget.fixed)

        def band_image(begin: int, end: int, *arrays: Any) -> Any:
            """Render rows from points, colours, thickness, maps and beta: arguments, as checkpoints want them."""
            *own, band_beta = arrays
            part = replace(surfaces, **dict(zip(_ARRAYS, own, strict=True)))
            # On the way back this runs again, outside of the caller's context.
            with part.in_order():
                triangles = part.triangles(replace(Window.of(surfaces.camera), first_row=begin, row_count=end - begin))
                inside = counts[begin * width : end * width]
                coverage = store_coverage(self.scene, self.camera, part, triangles, inside, budget, sort=True)
                return self._composite(coverage, part, _rows(band_beta, begin, end))

        inputs = (*(getattr(surfaces, name) for name in _ARRAYS), beta)
        if not surfaces.kind.records(array for array in inputs if kind_of(array) is surfaces.kind):
            return surfaces.kind.xp.concatenate([band_image(*band, *inputs) for band in bands])
        from torch.utils.checkpoint import checkpoint

        # A graph over all bands would hold all fragments: each keeps nothing, and is captured again on the way back.
        return surfaces.kind.xp.concatenate(
            [checkpoint(band_image, *band, *inputs, use_reentrant=False, preserve_rng_state=False) for band in bands]
        )


_ARRAYS = ("points", "rgba", "thickness", "maps")


def render(
    scene: Scene,
    camera: Camera | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    beta: Any = None,
    max_layers: int | None = None,
    merge: Merge | None = None,
    mix: Mix | None = None,
    background: bool = True,
    bounds: Bounds = "clamp",
    memory_limit: float | None = None,
) -> Any:
    """Render a scene: capture its fragments, merge them into layers, and composite those.

    Differentiable in everything that `capture` and `resolve` are; a gradient in vertices, or in a translation or
    rotation of an object or the camera, moves depths and attributes inside outlines, not the outlines. A `Renderer`
    renders many images of one scene.

    An image that would take more memory than allowed is rendered in bands of rows, with the same pixels to the bit;
    then its gradient is computed band by band, each of them captured once more.

    Args:
        scene: what to render.
        camera: where from; default the scene's.
        parameters: values in place of the scene's own, by the names of `scene.parameters()`: numbers, NumPy arrays, or
            torch tensors, in which the image is then differentiable.
        beta: see `resolve`; default `parameters["beta"]`, or else the scene's.
        max_layers: see `resolve`; default the scene's `layers`.
        merge: see `resolve`; default the scene's.
        mix: see `resolve`; default the scene's.
        background: whether to composite over the scene's background.
        bounds: what becomes of parameters out of their range: "clamp" puts them on its end, with a gradient that leads
            back in but not farther out; "error" refuses them.
        memory_limit: most memory that fragments and their gradients may take [bytes]; default half of what is free.

    Returns:
        Premultiplied linear colour and opacity, (H, W, 4): a torch tensor if any parameter (or beta) is one, else a
        NumPy array; float64 if any parameter (or beta) is an array of that, else float32.

    Raises:
        TypeError: an argument is of the wrong type.
        ValueError: an argument is out of its range.
        MemoryError: a single row would take more memory than allowed.

    Example:
        >>> wf.render(wf.load_scene("scenes/three_spheres.toml"), beta=0.5).shape
        (512, 512, 4)
    """
    renderer = Renderer(
        scene,
        camera,
        beta=beta,
        max_layers=max_layers,
        merge=merge,
        mix=mix,
        background=background,
        bounds=bounds,
        memory_limit=memory_limit,
    )
    return renderer.image(parameters)


def _beta_like(beta: Any, surfaces: CameraSurfaces) -> Any:
    """Return beta in the kind and precision of the image; numbers stay numbers."""
    kind = kind_of(beta)
    if kind is None:
        return beta
    if kind is surfaces.kind:
        return kind.astype(beta, dtype_name(surfaces.rgba))
    return surfaces.kind.asarray(beta, surfaces.rgba)


def _rows(beta: Any, begin: int, end: int) -> Any:
    return beta[begin:end] if kind_of(beta) is not None and len(beta.shape) == 2 else beta


def over_background(image: Any, background: tuple[float, float, float, float]) -> Any:
    """Composite a premultiplied image (H, W, 4), an array or a tensor, over a background of one colour."""
    if not any(background):
        return image
    kind = kind_of(image)
    assert kind is not None
    return image + (1.0 - image[..., 3:]) * kind.asarray(background, image)
