"""How the fragments of a pixel become layers: the options that everything takes that makes an image of a scene."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, get_args

from warpfrag.errors import check_choice, check_number, is_number, suggest
from warpfrag.fragments import Fragments, Layers
from warpfrag.resolve.options import check_options
from warpfrag.resolve.resolve import resolve
from warpfrag.scene.names import Merge, Mix
from warpfrag.scene.scene import Scene
from warpfrag.storage.into_slots import check_kbuffer
from warpfrag.storage.kbuffer import kbuffer

Resolve = Literal["sorted", "kbuffer"]


class Resolving(TypedDict, total=False):
    """How fragments become layers; what is left out, or None, is as the scene says.

    Attributes:
        resolve: "sorted", the default, sorts all fragments of a pixel; "kbuffer" streams them in order of submission
            into slots, see `kbuffer`.
        beta: see `resolve`; in place of `parameters["beta"]`. A k-buffer has none.
        max_layers: see `resolve`, or the slots of a k-buffer; default the scene's `layers`.
        merge: see `resolve` or `kbuffer`.
        mix: see `resolve`. A k-buffer has none.
    """

    resolve: Resolve
    beta: Any
    max_layers: int | None
    merge: Merge | None
    mix: Mix | None


@dataclass(frozen=True, eq=False)
class ResolveMethod:
    """How the fragments of a scene become layers, checked; see `Resolving`.

    Attributes:
        resolve: whether they are sorted, or streamed into a k-buffer.
        beta: that of the call, which comes before a parameter's; None without.
        max_layers: largest number of layers of a pixel.
        merge: how overlapping fragments merge.
        mix: how their colours are weighted.
    """

    resolve: Resolve
    beta: Any
    max_layers: int
    merge: Any
    mix: Any

    @staticmethod
    def of(scene: Scene, options: Mapping[str, Any]) -> "ResolveMethod":
        """Return what options, those of `Resolving`, make of a scene's own.

        Raises:
            TypeError: an option that does not exist, or of the wrong type.
            ValueError: an option out of its range.
        """
        known = Resolving.__annotations__
        for name in options:
            if name not in known:
                raise TypeError(f"{name}: got an argument of this name, expected a known one; {suggest(name, known)}")
        given = {name: value for name, value in options.items() if value is not None}
        method = str(given.get("resolve", "sorted"))
        max_layers = given.get("max_layers", scene.layers)
        merge, mix = given.get("merge", scene.merge), given.get("mix", scene.mix)
        beta = given.get("beta")
        if is_number(beta):
            # Nobody optimises a plain number: out of its range it is a mistake.
            check_number("beta", beta, 0.0, 1.0)
        check_choice("resolve", method, get_args(Resolve))
        if method == "kbuffer":
            check_kbuffer(max_layers, merge, "mix")
        else:
            check_options(merge, mix, max_layers)
        return ResolveMethod(method, beta, int(max_layers), merge, mix)  # type: ignore[arg-type]

    @property
    def sorts(self) -> bool:
        """Whether fragments are to be sorted by depth."""
        return self.resolve == "sorted"

    @property
    def options(self) -> Resolving:
        """The options that make this method again."""
        return Resolving(
            resolve=self.resolve, beta=self.beta, max_layers=self.max_layers, merge=self.merge, mix=self.mix
        )

    def layers(self, fragments: Fragments, beta: Any) -> Layers:
        """Return the layers of fragments."""
        if self.sorts:
            return resolve(fragments, beta, self.max_layers, self.merge, self.mix)
        return kbuffer(fragments, self.max_layers, merge=self.merge)
