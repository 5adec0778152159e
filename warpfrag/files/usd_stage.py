"""Reads the meshes of a USD stage into plain arrays, in a process of its own: run as a script, it imports no warpfrag.

    python usd_stage.py STAGE ROOT OUTPUT.npz BYTES

The output has arrays by `"<mesh>.<what>"`, and a text "told" in JSON: names of meshes, notes, or why it failed. Values
are taken at one time: the stage's start, or else the earliest of all samples.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

# Instancers may hold instancers, as deep as this.
_DEEPEST = 8
_MOST_INSTANCES = 2**22


class RefusedError(ValueError):
    """A stage that cannot be used, in one line."""


class Reading:
    """A stage at one time, and what has been found in it."""

    def __init__(self, stage: Any, time: Any) -> None:
        from pxr import UsdGeom

        self.stage, self.time = stage, time
        self.transforms = UsdGeom.XformCache(time)
        self.arrays: dict[str, np.ndarray] = {}
        self.meshes: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.kinds: set[str] = set()

    def note(self, text: str) -> None:
        """Remember what is left out, once."""
        if text not in self.notes:
            self.notes.append(text)

    def walk(self, root: Any, above: np.ndarray, depth: int = 0, name: str = "") -> None:
        """Take all that is drawn below a prim; `above` leads from the space above the prim to world space."""
        from pxr import Usd, UsdGeom

        span = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
        for prim in span:
            if not prim.IsA(UsdGeom.Imageable):
                continue
            shown = UsdGeom.Imageable(prim)
            if prim.IsA(UsdGeom.PointInstancer):
                span.PruneChildren()
            if not (prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)):
                continue
            hidden = shown.ComputeVisibility(self.time) == "invisible"
            if hidden or shown.ComputePurpose() in ("guide", "proxy"):
                continue
            matrix = above @ self._below(prim, root)
            if prim.IsA(UsdGeom.PointInstancer):
                self._instances(prim, matrix, depth)
            elif prim.IsA(UsdGeom.Mesh):
                self._mesh(UsdGeom.Mesh(prim), matrix, name or prim.GetName())
            else:
                self.kinds.add(str(prim.GetTypeName()))

    def _below(self, prim: Any, root: Any) -> np.ndarray:
        """Return the matrix from a prim's space to that in which `root` stands."""
        world = np.array(self.transforms.GetLocalToWorldTransform(prim)).T
        if root.IsPseudoRoot():
            return world
        parent = np.array(self.transforms.GetParentToWorldTransform(root)).T
        return np.linalg.inv(parent) @ world

    def _instances(self, prim: Any, matrix: np.ndarray, depth: int) -> None:
        from pxr import UsdGeom

        instancer = UsdGeom.PointInstancer(prim)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        which = np.asarray(instancer.GetProtoIndicesAttr().Get(self.time) or [], dtype=np.int64)
        moves = instancer.ComputeInstanceTransformsAtTime(self.time, self.time)
        mask = np.asarray(instancer.ComputeMaskAtTime(self.time), dtype=bool)
        if len(mask):
            which = which[mask]
        if depth >= _DEEPEST or len(moves) > _MOST_INSTANCES:
            raise RefusedError(f"got an instancer of {len(moves)} instances, {depth} deep, expected fewer")
        for index, move in zip(which, moves, strict=False):
            prototype = self.stage.GetPrimAtPath(targets[index]) if 0 <= index < len(targets) else None
            if prototype:
                # The transform of the prototype's root is part of that of the instance.
                own = np.array(self.transforms.GetLocalTransformation(prototype)[0]).T
                place = matrix @ np.array(move).T @ np.linalg.inv(own)
                self.walk(prototype, place, depth + 1, prim.GetName())

    def _mesh(self, mesh: Any, matrix: np.ndarray, name: str) -> None:
        from pxr import UsdGeom

        prim = mesh.GetPrim()
        arrays = {
            "points": np.asarray(mesh.GetPointsAttr().Get(self.time), dtype=np.float64),
            "counts": np.asarray(mesh.GetFaceVertexCountsAttr().Get(self.time), dtype=np.int64),
            "indices": np.asarray(mesh.GetFaceVertexIndicesAttr().Get(self.time), dtype=np.int64),
            "holes": np.asarray(mesh.GetHoleIndicesAttr().Get(self.time) or [], dtype=np.int64),
            "matrix": matrix,
        }
        if arrays["points"].ndim != 2 or arrays["counts"].ndim != 1 or not len(arrays["counts"]):
            return
        scheme = mesh.GetSubdivisionSchemeAttr()
        # Unsaid, a scheme is Catmull and Clark's; of triangles that is hardly ever meant.
        if scheme.Get() != "none" and (scheme.HasAuthoredValue() or arrays["counts"].max() > 3):
            self.note(f"subdivision ({scheme.Get()}) is not supported, drawn as the control mesh")
        told: dict[str, Any] = {"name": name, "path": str(prim.GetPath())}
        told["mirrored"] = mesh.GetOrientationAttr().Get(self.time) == UsdGeom.Tokens.leftHanded
        primvars = UsdGeom.PrimvarsAPI(prim)
        for key, primvar in (("color", "displayColor"), ("opacity", "displayOpacity"), ("normals", "normals")):
            values, where = self._primvar(primvars.FindPrimvarWithInheritance(primvar))
            if values is None and key == "normals":
                values, where = self._normals(mesh)
            if values is not None:
                arrays[key], told[key] = values, where
        self._looks(prim, arrays, told)
        number = len(self.meshes)
        self.arrays.update({f"{number}.{key}": values for key, values in arrays.items()})
        self.meshes.append(told)

    def _primvar(self, primvar: Any) -> tuple[np.ndarray | None, str]:
        values = primvar.ComputeFlattened(self.time) if primvar and primvar.HasValue() else None
        if values is None or (np.ndim(values) and not len(values)):
            return None, "constant"
        array = np.asarray(values, dtype=np.float64)
        array = array if np.ndim(values) else array[None]
        return (array, str(primvar.GetInterpolation())) if np.isfinite(array).all() else (None, "constant")

    def _normals(self, mesh: Any) -> tuple[np.ndarray | None, str]:
        given = mesh.GetNormalsAttr().Get(self.time)
        values = np.asarray(given, dtype=np.float64) if given is not None and len(given) else None
        return values, str(mesh.GetNormalsInterpolation())

    def _looks(self, prim: Any, arrays: dict[str, np.ndarray], told: dict[str, Any]) -> None:
        """Take the constants of bound materials: of the mesh, and of its subsets of faces."""
        from pxr import UsdShade

        binding = UsdShade.MaterialBindingAPI(prim)
        bound: list[tuple[Any, Any]] = [(None, binding.ComputeBoundMaterial()[0])]
        for subset in binding.GetMaterialBindSubsets():
            faces = np.asarray(subset.GetIndicesAttr().Get(self.time) or [], dtype=np.int64)
            bound.append((faces, UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]))
        looks: list[dict[str, Any]] = []
        for faces, material in bound:
            look = self._look(material) if material else None
            if look is not None:
                look["faces"] = None if faces is None else len(looks)
                if faces is not None:
                    arrays[f"faces{len(looks)}"] = faces
                looks.append(look)
        told["looks"] = looks

    def _look(self, material: Any) -> dict[str, Any] | None:
        """Return colour and opacity of a material, None where that of the mesh counts."""
        shader = material.ComputeSurfaceSource()[0]
        name = material.GetPrim().GetName()
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            what = shader.GetIdAttr().Get() if shader else "no surface"
            self.note(f"material {name} ({what}) is not supported, drawn without")
            return None
        color = self._input(shader, "diffuseColor", (0.18, 0.18, 0.18), name)
        opacity = self._input(shader, "opacity", 1.0, name)
        threshold = self._input(shader, "opacityThreshold", 0.0, name)
        if opacity is not None and threshold:
            opacity = 1.0 if opacity >= threshold else 0.0
        emission = self._input(shader, "emissiveColor", (0.0, 0.0, 0.0), name)
        if emission is not None and any(emission):
            self.note("the light that materials emit is not drawn")
        return {"color": None if color is None else [float(part) for part in color], "opacity": opacity}

    def _input(self, shader: Any, key: str, default: Any, name: str) -> Any:
        """Return an input of a shader; None, and noted, where an image or the mesh gives it."""
        given = shader.GetInput(key)
        if not given:
            return default
        attributes = given.GetValueProducingAttributes()
        producer = attributes[0] if attributes else None
        if producer is None or producer.GetPrim() == shader.GetPrim() or not producer.GetPrim().IsA("Shader"):
            value = producer.Get(self.time) if producer else given.Get(self.time)
            return default if value is None else value
        source = producer.GetPrim().GetAttribute("info:id").Get()
        if not str(source).startswith("UsdPrimvarReader"):
            self.note(f"texture: {key} of material {name} ({source}) is not supported, drawn without")
        return None


def read_stage(path: Path, root: Path) -> Reading:
    """Read a stage.

    Raises:
        RefusedError: it refers to files outside of `root`.
    """
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    for layer in stage.GetUsedLayers():
        used = layer.realPath.split("[")[0]
        if used and Path(used).resolve() != path.resolve() and not Path(used).resolve().is_relative_to(root.resolve()):
            raise RefusedError(f"got a reference to {used} in {path}, expected references inside {root}")
    reading = Reading(stage, _time(stage))
    reading.walk(stage.GetPseudoRoot(), np.eye(4))
    return reading


def _time(stage: Any) -> Any:
    """Return the one time at which all values are taken."""
    from pxr import Usd

    if stage.HasAuthoredTimeCodeRange():
        return Usd.TimeCode(stage.GetStartTimeCode())
    earliest = None
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        for attribute in prim.GetAuthoredAttributes():
            if attribute.ValueMightBeTimeVarying() or attribute.GetNumTimeSamples():
                samples = attribute.GetTimeSamples()
                earliest = min([*samples[:1], *([] if earliest is None else [earliest])], default=None)
    return Usd.TimeCode.Default() if earliest is None else Usd.TimeCode(earliest)


def told_of(reading: Reading) -> dict[str, Any]:
    """Return what is told of a stage beside its arrays."""
    return {"meshes": reading.meshes, "notes": reading.notes, "kinds": sorted(reading.kinds)}


def main(words: list[str]) -> int:
    """Read a stage and write what it holds; the exit status is 0 if that was written."""
    path, root, output, most_bytes = Path(words[0]), Path(words[1]), words[2], int(words[3])
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    except (ImportError, ValueError, OSError):
        # Not on this platform.
        pass
    arrays: dict[str, np.ndarray] = {}
    told: dict[str, Any] = {}
    try:
        reading = read_stage(path, root)
        arrays = reading.arrays
        told = told_of(reading)
    except MemoryError:
        told = {"error": "memory"}
    except RefusedError as error:
        told = {"refused": str(error)}
    except Exception as error:
        # USD's errors are lists, the first of which says where the file is wrong.
        first = getattr(error.args[0], "commentary", None) if error.args else None
        reason = " ".join(str(first or error).split())
        told = {"error": reason[:200] or type(error).__name__}
    np.savez(output, told=np.array(json.dumps(told)), **arrays)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
