"""How the primitives of a glTF document look: factors, vertex colours and images, by the alpha mode of their material.

OPAQUE is opacity 1 whatever alpha says; MASK draws, opaque, where factor · vertex alpha · image alpha reaches the
cut-off; BLEND draws alpha as it is. Factors and vertex colours are linear, images sRGB whatever they say themselves.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warpfrag.files.gltf_document import Document
from warpfrag.files.pixels import MOST_PIXELS, decode_image, with_opacity
from warpfrag.files.texture_images import Sampling, Wrap, fitted_image, shared_key
from warpfrag.shapes.masking import cut_at_opacity
from warpfrag.shapes.mesh import Mesh

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_OTHER_SOURCES = ("EXT_texture_webp", "EXT_texture_avif")
# Of all images of a document together.
_MOST_PIXELS = 4 * MOST_PIXELS


@dataclass(frozen=True)
class _Surface:
    """What a material says about colour: its factor (4,), its image's texture info, and what alpha means."""

    factor: np.ndarray
    texture: dict[str, Any] | None
    mode: str
    cutoff: float


class Looks:
    """The materials of a document, with each image decoded once."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._images: dict[int, np.ndarray | None] = {}
        self._fitted: dict[tuple, np.ndarray] = {}
        self._pixels = 0

    def apply(self, mesh: Mesh, primitive: dict[str, Any], attributes: dict[str, np.ndarray]) -> Mesh:
        """Give a primitive's mesh its colour, opacity and image.

        Args:
            mesh: its geometry.
            primitive: its entry in the document.
            attributes: TEXCOORD_n (V, 2) and COLOR_0 (V, 3 or 4), by name.
        """
        material, colors = primitive.get("material"), attributes.get("COLOR_0")
        surface = self._surface(material) if material is not None else _Surface(np.ones(4), None, "OPAQUE", 0.5)
        color: np.ndarray | None = surface.factor[:3] if material is not None else None
        alpha: Any = float(surface.factor[3])
        if colors is not None:
            color = np.maximum((np.ones(3) if color is None else color) * colors[:, :3], 0.0)
            if colors.shape[1] == 4:
                alpha = alpha * np.clip(colors[:, 3], 0.0, 1.0)
        mesh = replace(mesh, color=color)
        image, uv, sampling = self._texture(surface, attributes, len(mesh.vertices))
        if surface.mode == "OPAQUE":
            alpha = 1.0
        if image is None:
            if surface.mode == "MASK":
                return cut_at_opacity(replace(mesh, opacity=_even(alpha)), surface.cutoff)
            return replace(mesh, opacity=_even(alpha))
        assert uv is not None
        alpha = _even(alpha)
        if surface.mode == "MASK":
            if np.ndim(alpha) == 0 or image[..., 3].min() < image[..., 3].max():
                if np.ndim(alpha):
                    self.document.source.note("alpha of vertices and of an image in one mask, drawn with the image's")
                    alpha = surface.factor[3]
                # With an even alpha the cut-off is one for the image.
                limit = surface.cutoff / float(alpha) if alpha > 0.0 else np.inf
                sampling = Sampling(sampling.wrap, sampling.nearest, limit if surface.cutoff > 0.0 else 0.0)
                alpha = 1.0
            else:
                # The image's alpha is the same everywhere: the cut is where that of the vertices says.
                mesh = cut_at_opacity(replace(mesh, opacity=alpha * image[0, 0, 3], uv=uv), surface.cutoff)
                assert mesh.uv is not None
                uv, alpha = mesh.uv, mesh.opacity
                image = image.copy()
                image[..., 3] = 1.0
        key = (id(image) if sampling.cutoff is None else (id(image), sampling.cutoff), *shared_key(uv, sampling))
        if surface.mode == "OPAQUE" and image[..., 3].min() < 1.0:
            key = (*key, "opaque")
        fitted, uv, left_out = self._fit(key, image, uv, sampling, opaque=surface.mode == "OPAQUE")
        if left_out:
            self.document.source.note(left_out)
        return replace(mesh, color=np.ones(3) if color is None else mesh.color, opacity=alpha, uv=uv, textures=[fitted])

    def _fit(
        self, key: tuple, image: np.ndarray, uv: np.ndarray, sampling: Sampling, *, opaque: bool
    ) -> tuple[np.ndarray, np.ndarray, str]:
        if opaque and image[..., 3].min() < 1.0:
            image = image.copy()
            image[..., 3] = 1.0
        fitted, uv, left_out = fitted_image(image, uv, sampling)
        # Images that are equal are one, so that a scene holds them once.
        return self._fitted.setdefault(key, fitted), uv, left_out

    def _surface(self, index: int) -> _Surface:
        material = self.document.entry("materials", index)
        base = material.get("pbrMetallicRoughness", {})
        factor, texture = base.get("baseColorFactor"), base.get("baseColorTexture")
        older = self.document.extension(material, "KHR_materials_pbrSpecularGlossiness")
        if older is not None:
            factor, texture = older.get("diffuseFactor"), older.get("diffuseTexture")
        if np.any(material.get("emissiveFactor", 0.0)):
            self.document.source.note("the light that materials emit is not drawn")
        values = np.ones(4) if factor is None else np.asarray(factor, dtype=np.float64)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise ValueError(f"got {factor!r:.60} for the colour of material {index}, expected 4 numbers")
        values[3] = min(max(values[3], 0.0), 1.0)
        cutoff = material.get("alphaCutoff", 0.5)
        return _Surface(np.maximum(values, 0.0), texture, material.get("alphaMode", "OPAQUE"), float(cutoff))

    def _texture(
        self, surface: _Surface, attributes: dict[str, np.ndarray], count: int
    ) -> tuple[np.ndarray | None, np.ndarray | None, Sampling]:
        """Return a surface's image, the coordinates for it (v up), and how it is looked up."""
        info = surface.texture
        if info is None:
            return None, None, Sampling()
        transform = self.document.extension(info, "KHR_texture_transform") or {}
        uv = attributes.get(f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}")
        texture = self.document.entry("textures", info.get("index"))
        image = self._image(texture)
        if image is None:
            return None, None, Sampling()
        if uv is None or uv.shape != (count, 2) or not np.isfinite(uv).all():
            self.document.source.note("texture: a primitive without its coordinates, drawn without")
            return None, None, Sampling()
        if transform:
            uv = _transformed(uv, transform)
        sampler = self.document.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
        wraps = tuple(_WRAPS.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
        sampling = Sampling((wraps[0], wraps[1]), sampler.get("magFilter") == _NEAREST)
        return image, np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=-1), sampling

    def _image(self, texture: dict[str, Any]) -> np.ndarray | None:
        index = texture.get("source")
        for name in _OTHER_SOURCES:
            other = self.document.extension(texture, name)
            index = other.get("source", index) if other is not None else index
        if index is None:
            names = ", ".join(texture.get("extensions", {})) or "no image"
            self.document.source.note(f"texture: {names} is not supported, drawn without")
            return None
        if index not in self._images:
            self._images[index] = self._decoded(self.document.entry("images", index))
        return self._images[index]

    def _decoded(self, image: dict[str, Any]) -> np.ndarray | None:
        uri = image.get("uri")
        if isinstance(uri, str):
            data = self.document.bytes_of_uri(uri)
        else:
            data = self.document.bytes_of_view(image.get("bufferView"))
        if data is None:
            return None
        try:
            pixels = with_opacity(decode_image(data, managed=False))
        # Decoders raise whatever they like on broken images.
        except Exception as error:
            reason = " ".join(str(error).split())[:80] or type(error).__name__
            name = image.get("name") or (uri if isinstance(uri, str) and len(uri) < 80 else "image")
            self.document.source.note(f"texture: {name} cannot be read ({reason}), drawn without")
            return None
        self._pixels += pixels.shape[0] * pixels.shape[1]
        if self._pixels > _MOST_PIXELS:
            raise ValueError(f"got images of more than {_MOST_PIXELS} pixels together")
        return pixels


def _transformed(uv: np.ndarray, transform: dict[str, Any]) -> np.ndarray:
    """Apply KHR_texture_transform: scaled first, then turned counter-clockwise as the image is seen, moved last."""
    angle = float(transform.get("rotation", 0.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    # v points down: what is counter-clockwise there has the signs of a clockwise turn.
    u, v = (uv * np.asarray(transform.get("scale", (1.0, 1.0)), dtype=np.float64)).T
    offset = np.asarray(transform.get("offset", (0.0, 0.0)), dtype=np.float64)
    return np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=-1) + offset


def _even(values: Any) -> Any:
    """Return values that are all the same as one number."""
    if np.ndim(values) and len(values) and values.min() == values.max():
        return float(values[0])
    return values
