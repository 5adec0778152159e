"""A renderer: images of one scene from one camera, in bands of rows where memory is short."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, Literal, Unpack, get_args

import numpy as np
import warp as wp

from warpfrag.arrays.devices import check_device
from warpfrag.arrays.kinds import common_kind, dtype_name, kind_of
from warpfrag.arrays.warp_calls import call_with_warp, named_values
from warpfrag.capture.bounded import kbuffer_of_surfaces
from warpfrag.capture.coverage import Coverage, store_coverage
from warpfrag.capture.foremost import foremost, foremost_normals
from warpfrag.capture.memory import Budget, CaptureSizes, split_rows
from warpfrag.capture.surfaces import CameraSurfaces, SurfaceTables, check_scene, surfaces_of
from warpfrag.composite import composite
from warpfrag.errors import check_choice, check_whole, shorten
from warpfrag.fragments import Fragments
from warpfrag.raster.ray import Window
from warpfrag.resolving import ResolveMethod, Resolving
from warpfrag.samples import by_sample, over_background, pixel_means, sampled_surfaces, sampling_camera
from warpfrag.scene.camera import Camera
from warpfrag.scene.parameters import BETA, Bounds, bounded_beta
from warpfrag.scene.scene import Scene
from warpfrag.scene.visibility import warn_if_empty
from warpfrag.storage.into_slots import kbuffer_bytes
from warpfrag.storage.kbuffer import kbuffer
from warpfrag.storage.method import count_fragments

Output = Literal["color", "depth", "normal", "object_id", "count", "layers"]
OUTPUTS: tuple[Output, ...] = get_args(Output)
# What layers alone tell.
_OF_LAYERS = {"color", "count", "layers"}
# Samples along the edge of a pixel beyond this are a slip of the keyboard.
MOST_SAMPLES = 64
# Of a sample's colour, and of what it is made of or its gradient: numbers.
SAMPLE_NUMBERS = 8


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
        samples: see `render`.
        background: whether to composite over the scene's background.
        bounds: see `render`.
        memory_limit: see `render`.
        device: see `render`.
        resolving: how fragments become layers, see `Resolving`: `resolve`, `beta`, `max_layers`, `merge`, `mix`.

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
        samples: int = 1,
        background: bool = True,
        bounds: Bounds = "clamp",
        memory_limit: float | None = None,
        device: Any = None,
        **resolving: Unpack[Resolving],
    ):
        self.camera = check_scene(scene, camera)
        self.scene = scene
        self.method = ResolveMethod.of(scene, resolving)
        self.samples = check_whole("samples", samples, 1, MOST_SAMPLES)
        self.background, self.bounds, self.memory_limit = background, bounds, memory_limit
        self.device = check_device(device)
        self._tables: SurfaceTables | None = None
        self._coverage: Coverage | None = None
        self._sizes: CaptureSizes | None = None
        self._centres: Renderer | None = None

    def __repr__(self) -> str:
        width, height = self.camera.size
        return f"Renderer({self.scene!r}, {width} × {height}, {self.method.resolve})"

    @property
    def coverage(self) -> Coverage:
        """What each pixel (with several samples, each sample) saw the last time, or else sees in the scene as it is.

        Raises:
            MemoryError: it would take more memory than allowed.
        """
        if self._coverage is None:
            surfaces = self._surfaces({}, self.device)
            with surfaces.in_order():
                self._seen(surfaces)
        assert self._coverage is not None
        return self._coverage

    def fragments(self, parameters: Mapping[str, Any] | None = None) -> Fragments:
        """Return the fragments for parameter values, as `capture` does: sorted, or for a k-buffer as submitted.

        With several samples they are those of the samples.

        Raises:
            TypeError: a value is of the wrong type.
            ValueError: a value is out of its range.
            MemoryError: they would take more memory than allowed.
        """

        def shade(values: Mapping[str, Any], device: str | None) -> Fragments:
            surfaces = self._surfaces(values, device)
            with surfaces.in_order():
                return surfaces.given(self._seen(surfaces).shade_surfaces(surfaces, moved=False))

        return call_with_warp(shade, named_values(parameters), self.scene.value_shapes(), self.device)

    def image(self, parameters: Mapping[str, Any] | None = None, output: Output | Sequence[Output] = "color") -> Any:
        """Return the image for parameter values; see `render`, also for other outputs and for what is raised."""
        wanted = check_outputs(output)
        # As a parameter beta has its say in the kind and precision of the image.
        values = named_values(parameters, beta=self.method.beta)

        def draw(given: Mapping[str, Any], device: str | None) -> Any:
            return self.draw(given, wanted, device)

        found = call_with_warp(draw, values, self.scene.value_shapes(), self.device)
        return found[output] if isinstance(output, str) else found

    def draw(self, values: Mapping[str, Any], wanted: Sequence[str], device: str | None = None) -> dict[str, Any]:
        """Return outputs by name for parameter values, NumPy arrays or torch tensors; beta is among the values."""
        if self.samples > 1 and (others := [name for name in wanted if name != "color"]):
            # Whatever else there is has no mean: it is that of the pixels' centres.
            if self._centres is None:
                options = {"background": self.background, "bounds": self.bounds, "memory_limit": self.memory_limit}
                self._centres = Renderer(self.scene, self.camera, **options, **self.method.options)  # type: ignore[arg-type]
            parts = self._centres.draw(values, others, device)
            parts |= self.draw(values, ["color"], device) if "color" in wanted else {}
            return {name: parts[name] for name in wanted}
        surfaces = self._surfaces(values, device)
        beta = _beta_like(bounded_beta(values.get(BETA.key, self.scene.beta), self.bounds), surfaces)
        if self.samples > 1 and kind_of(beta) is not None and tuple(beta.shape) not in ((), (1,), self.camera.shape):
            raise ValueError(f"beta: got shape {tuple(beta.shape)}, expected () or {self.camera.shape}")
        with surfaces.in_order():
            found = self._cover(surfaces)
            if isinstance(found, Coverage):
                warn_if_empty(found.count, self.scene, self.camera)
                drawn = self._pictures(found, surfaces, beta, wanted)
            elif self.method.sorts or not _OF_LAYERS.issuperset(wanted):
                drawn = self._pictures_in_bands(surfaces, found, beta, wanted)
            else:
                drawn = self._pictures_of_slots(surfaces, wanted)
            return dict(zip(wanted, drawn, strict=True))

    def _surfaces(self, parameters: Mapping[str, Any], device: str | None) -> CameraSurfaces:
        surfaces = surfaces_of(
            self.scene, self.camera, parameters, self._tables, bounds=self.bounds, device=device or self.device
        )
        self._tables = surfaces.tables
        return sampled_surfaces(surfaces, self.samples)

    def _seen(self, surfaces: CameraSurfaces) -> Coverage:
        found = self._cover(surfaces)
        if isinstance(found, Coverage):
            return found
        total = int(found.row_counts.sum())
        self._budget(surfaces).check(total, self._sample_count, f"{total} fragments")
        raise AssertionError("what does not fit is refused")

    def _cover(self, surfaces: CameraSurfaces) -> Coverage | _Counted:
        """Return what each pixel sees, kept from the last time if that is the same, or why there is no room for it."""
        kept = self._coverage
        if kept is not None and kept.is_of(surfaces):
            if self._budget(surfaces).allows(kept.count, self._sample_count):
                self._coverage = kept.to(surfaces.device)
                return self._coverage
            self._coverage = None
        triangles = surfaces.triangles(Window.of(surfaces.camera))
        self._sizes = CaptureSizes.of(triangles, surfaces)
        budget, counts = self._budget(surfaces), count_fragments(triangles)
        row_counts = counts.numpy().reshape(surfaces.camera.shape).sum(axis=1, dtype=np.int64)
        if not budget.allows(int(row_counts.sum()), self._sample_count):
            return _Counted(counts, row_counts)
        # The old one goes before the new one comes.
        self._coverage = kept = None
        self._coverage = store_coverage(
            self.scene, surfaces.camera, surfaces, triangles, counts, budget, sort=self.method.sorts
        )
        return self._coverage

    def _budget(self, surfaces: CameraSurfaces) -> Budget:
        assert self._sizes is not None
        sizes, number = self._sizes, surfaces.number
        layer = 0 if self.method.sorts else kbuffer_bytes(1, self.method.max_layers, number)
        if self.samples > 1:
            # Pixels make up the image; samples are there for as long as their band.
            height, width = self.camera.shape
            sizes = replace(sizes, pixel_count=height * width)
            layer += SAMPLE_NUMBERS * wp.types.type_size_in_bytes(number)
        return Budget.of(sizes, self.memory_limit, surfaces, image=True, layer=layer)

    def _pictures(self, coverage: Coverage, surfaces: CameraSurfaces, beta: Any, wanted: Sequence[str]) -> list[Any]:
        """Return the outputs of what surfaces look like where they are seen, for beta by pixel."""
        beta = by_sample(beta, self.samples) if kind_of(beta) is not None and len(beta.shape) == 2 else beta
        if list(wanted) == ["color"]:
            # Not held by a name: with the image there, the fragments may go.
            return [self._finished(self._composite(coverage.shade_surfaces(surfaces, moved=False), beta), surfaces)]
        fragments = coverage.shade_surfaces(surfaces, moved=False)
        found: dict[str, Any] = {}
        if not _OF_LAYERS.isdisjoint(wanted):
            if "color" in wanted:
                found["color"] = self._finished(self._composite(fragments, beta), surfaces)
            if "layers" in wanted or "count" in wanted:
                found["layers"] = surfaces.given(self.method.layers(fragments, beta))
                found["count"] = found["layers"].count
        if not _OF_LAYERS.issuperset(wanted):
            front = foremost(fragments)
            found["depth"], found["object_id"] = surfaces.given(front.depth), surfaces.given(front.object_id)
            if "normal" in wanted:
                found["normal"] = surfaces.given(foremost_normals(coverage, surfaces, front.fragment))
        return [found[name] for name in wanted]

    def _composite(self, fragments: Fragments, beta: Any) -> Any:
        how = self.method
        if not how.sorts:
            return composite(kbuffer(fragments, how.max_layers, merge=how.merge))
        return composite(fragments, beta, max_layers=how.max_layers, merge=how.merge, mix=how.mix)

    def _finished(self, image: Any, surfaces: CameraSurfaces) -> Any:
        """Return the image of pixels, over the background, made of the colours of samples."""
        image = pixel_means(surfaces.given(image), self.samples)
        return over_background(image, self.scene.background) if self.background else image

    def _pictures_of_slots(self, surfaces: CameraSurfaces, wanted: Sequence[str]) -> list[Any]:
        """Return what layers tell, without room for fragments: these go straight into a k-buffer."""
        window, how = Window.of(surfaces.camera), self.method
        layers = kbuffer_of_surfaces(
            surfaces, window, self.memory_limit, slots=how.max_layers, merge=how.merge, tail="mix"
        )
        given = surfaces.given(layers)
        found: dict[str, Any] = {"layers": given, "count": given.count}
        if "color" in wanted:
            found["color"] = self._finished(composite(layers), surfaces)
        return [found[name] for name in wanted]

    @property
    def _sample_count(self) -> int:
        height, width = sampling_camera(self.camera, self.samples).shape
        return height * width

    def _pictures_in_bands(
        self, surfaces: CameraSurfaces, found: _Counted, beta: Any, wanted: Sequence[str]
    ) -> list[Any]:
        budget, counts, samples = self._budget(surfaces), found.counts, self.samples
        row_counts, width = found.row_counts.reshape(-1, samples).sum(axis=1), surfaces.camera.width
        row_bytes = budget.needed(row_counts, width * samples)
        bands = split_rows(row_counts, row_bytes, budget.allowed, budget.fixed)

        def band_pictures(begin: int, end: int, *arrays: Any) -> list[Any]:
            """Draw rows from points, colours, thickness, maps and beta: arguments, as checkpoints want them."""
            *own, band_beta = arrays
            part = replace(surfaces, **dict(zip(_ARRAYS, own, strict=True)))
            first, count = begin * samples, (end - begin) * samples
            # On the way back this runs again, outside of the caller's context.
            with part.in_order():
                triangles = part.triangles(replace(Window.of(surfaces.camera), first_row=first, row_count=count))
                inside = counts[first * width : (first + count) * width]
                coverage = store_coverage(
                    self.scene, part.camera, part, triangles, inside, budget, sort=self.method.sorts
                )
                return self._pictures(coverage, part, _rows(band_beta, begin, end), wanted)

        inputs = (*(getattr(surfaces, name) for name in _ARRAYS), beta)
        if not surfaces.kind.records(array for array in inputs if kind_of(array) is surfaces.kind):
            return joined([band_pictures(*band, *inputs) for band in bands], "concatenate")
        from torch.utils.checkpoint import checkpoint

        # A graph over all bands would hold all fragments: each keeps nothing, and is captured again on the way back.
        options = {"use_reentrant": False, "preserve_rng_state": False}
        return joined([checkpoint(band_pictures, *band, *inputs, **options) for band in bands], "concatenate")


_ARRAYS = ("points", "rgba", "thickness", "maps")


def check_outputs(output: Any) -> list[str]:
    """Return the names of one or several outputs.

    Raises:
        TypeError: it is neither a name nor a sequence of them.
        ValueError: it names none, one twice, or one that does not exist.
    """
    if not isinstance(output, (str, Sequence)) or isinstance(output, bytes):
        raise TypeError(f"output: got {shorten(output)}, expected a name or a sequence of names")
    names = [output] if isinstance(output, str) else list(output)
    for name in names:
        check_choice("output", name, OUTPUTS)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"output: got {shorten(names)}, expected one or more names, each once")
    return names


def joined(results: Sequence[Sequence[Any]], function: Literal["concatenate", "stack"]) -> list[Any]:
    """Return several results, each of arrays or layers, as one: with all rows, or with a leading dimension.

    Args:
        results: NumPy arrays or torch tensors, or dataclasses of them, in the same places of each.
        function: how arrays are put together.
    """

    def join(parts: Sequence[Any]) -> Any:
        first = parts[0]
        if is_dataclass(first) and not isinstance(first, type):
            return replace(first, **{name: join([getattr(part, name) for part in parts]) for name in vars(first)})
        return getattr(common_kind({"output": first}).xp, function)(list(parts))

    return [join(parts) for parts in zip(*results, strict=True)]


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
