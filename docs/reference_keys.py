"""Every key of scene files and study files: what `make_reference.py` writes down and the tests try on the readers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from warpfrag.fit.parameters import FitParameter
from warpfrag.fit.study import Study
from warpfrag.fit.views import View
from warpfrag.scene.camera import Camera
from warpfrag.scene.light import Light
from warpfrag.scene.scene import Scene
from warpfrag.shapes.surfels import surfels

ITEM = "scene units"


@dataclass(frozen=True)
class Key:
    """A key of a table.

    Attributes:
        name: the key.
        value: what kind of value it takes, and its range.
        default: words; or the class or function whose field or argument of this name has it as its default.
        unit: what numbers are counted in; empty for none.
        example: a value, as a file would have it.
        meaning: what it does.
        refused: values out of range, as a file would have them.
        beside: keys that the example needs in its table; None takes one of them away.
    """

    name: str
    value: str
    default: str | Callable[..., Any]
    unit: str
    example: str
    meaning: str
    refused: tuple[str, ...] = ()
    beside: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """A table of a file.

    Attributes:
        title: its heading.
        file: "scene" or "study".
        place: the table's name; empty at the top of the file.
        words: what is said before the keys.
        keys: its keys.
    """

    title: str
    file: str
    place: str
    words: str
    keys: tuple[Key, ...]


_THREE = ("[1, 2]", '"up"', "[0, 0, 1e39]")
_MERGES = "`none`, `smooth`, `order_independent` or `exact`"
_MIXES = "`opacity`, `average` or `optical_depth`"
_OPTIONS = (
    Key("layers", "whole number, 1 to 2³¹ − 1", Scene, "", "16",
        "most layers of a pixel; what does not fit is composited into the last", ("0", "2.5", "2147483648")),
    Key("merge", _MERGES, Scene, "", '"exact"', "how overlapping fragments become layers", ('"smoth"', "1")),
    Key("mix", _MIXES, Scene, "", '"optical_depth"', "how the colours of what overlaps are weighted", ('"mean"',)),
)  # fmt: skip
_CAMERA = (
    Key("eye", "3 numbers", "required", ITEM, "[0.0, 0.4, 4.5]", "position of the eye", _THREE),
    Key("target", "3 numbers, not the eye", "required", ITEM, "[0.0, 0.1, 0.0]",
        "the point in the middle of the image", (*_THREE, "[0, 0, 3]")),
    Key("up", "3 numbers, not along the view", Camera, "", "[1.0, 2.0, 0.0]", "the direction that is up in the image",
        (*_THREE, "[0, 0, 0]", "[0, 0, 2]")),
    Key("fov", "number between 0 and 180", "one of `fov` and `height` is required", "degrees", "32.0",
        "vertical opening angle of a perspective camera", ("0", "180", '"wide"')),
    Key("height", "number above 0", "one of `fov` and `height` is required", ITEM, "3.9",
        "vertical extent of the image of an orthographic camera", ("0", "-1.0"), {"fov": None}),
    Key("near", "number above 0", Camera, ITEM, "0.1", "planar depth from which on things are seen", ("0", "200.0")),
    Key("far", "number above `near`", Camera, ITEM, "20.0", "planar depth up to which things are seen", ("0.01",)),
    Key("size", "2 whole numbers, each 1 to 65,536; 2²⁸ pixels in all", Camera, "pixels", "[1280, 720]",
        "width and height of the image", ("[0, 5]", "[512.0, 512]", "[65537, 1]", "[65536, 65536]", "512")),
)  # fmt: skip
_LOOK = (
    Key("name", "text, one of its own; not `camera`", "the primitive's, or the file's without its suffix", "",
        '"left wing"', "first part of the names of the object's parameters, such as `left wing.thickness`",
        ('""', '"camera"', "3")),
    Key("color", '3 numbers, 0 to 1, linear; or `"#rrggbb"`, sRGB', "the file's own, else a grey of 0.8", "",
        '"#e02040"', "replaces colours and images of the file; tints a `texture`", ("[1, 1, 2]", '"red"', "[1, 1]")),
    Key("opacity", "number, 0 to 1", "the file's own, else 1", "", "0.5",
        "replaces the file's alpha; what an image cuts out (alpha 0) stays cut out", ("1.5", "-0.1")),
    Key("thickness", 'number from 0; or `"2P"`: multiples of P(z), the depth resolution (`wf.z_resolution`)',
        '`"2P"`; `"10P"` for points', ITEM, "0.05",
        "length of the slab in front of each fragment, along the ray; with `split` also a table by the parts' names",
        ("-1", '"2Q"', '"-2P"', "1e39")),
    Key("texture", "path of an image", "none", "", '"assets/lattice.png"',
        "straight sRGB colours; spheres, cylinders, cones and tori, and meshes with texture coordinates, take one",
        ('"missing.png"', "1")),
    Key("normals", "`smooth` or `flat`", "the file's own, else `smooth`", "", '"flat"',
        "for the light; not of points", ('"round"',)),
)  # fmt: skip
_PLACE = (
    Key("scale", "number other than 0, or 3 of them", "1", "", "[1.0, 2.0, 1.0]", "comes first", ("0", "[1, 1]")),
    Key("rotate", "`{ axis = [x, y, z], degrees = … }`, or a list of them", "none", "degrees",
        "{ axis = [0, 1, 0], degrees = 30 }", "comes second; of a list one after the other",
        ("30", "{ axis = [0, 0, 0], degrees = 30 }", "{ axis = [0, 1, 0] }")),
    Key("translate", "3 numbers", "`[0, 0, 0]`", ITEM, "[0.5, 0.0, 0.0]", "comes last", _THREE),
    Key("matrix", "4 rows of 4 numbers, invertible, the last row 0, 0, 0, 1", "none", ITEM,
        "[[1, 0, 0, 0], [0.5, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "in place of the three others",
        ("[[1, 0], [0, 1]]", "[[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]")),
)  # fmt: skip
_SEGMENTS = "whole number, 3 to 4096"
SECTIONS = (
    Section("Top of the file", "scene", "", "", (
        Key("beta", "number, 0 to 1", Scene, "", "0.5",
            "how a slab fills up from front to back: 0 exponentially, 1 linearly", ("1.5", "-0.1", "true")),
        *_OPTIONS,
        Key("background", '3 or 4 numbers, 0 to 1, linear and straight; or `"#rrggbb"`, `"#rrggbbaa"`, sRGB',
            "transparent", "", "[1.0, 1.0, 1.0]", "what is behind everything", ("[2, 0, 0]", '"white"')),
    )),
    Section("`[camera]`", "scene", "camera", "Required.", _CAMERA),
    Section("`[light]`", "scene", "light",
        "A white light on both sides of surfaces: colours are multiplied by ambient + (1 − ambient)·|n·l|. Without "
        "this table all is unlit.", (
        Key("direction", '3 numbers that are not all 0; or `"camera"`', '`"camera"`', "", "[0.4, 0.8, 1.0]",
            "towards the light; `camera` is from the eye", ("[0, 0, 0]", '"left"')),
        Key("ambient", "number, 0 to 1", Light, "", "0.4", "share that comes from everywhere", ("1.5", "-1")),
    )),
    Section("`[[object]]`: shape", "scene", "object",
        "One or more objects, each with one of `mesh`, `primitive` and `points`. Paths are relative to the scene file "
        "and stay in its folder or below, or are absolute.", (
        Key("mesh", 'path of a glTF, OBJ, PLY, STL, OFF or USD file; or `"warp:<asset>"`', "none", "",
            '"assets/egg.glb"', "with its own colours, opacities, images, normals", ('"missing.ply"', "1"),
            {"primitive": None}),
        Key("split", "`nodes` (glTF, USD) or `groups` (OBJ)", "none: one object", "", '"nodes"',
            "an object for each part of the mesh, with its name there, after `name` and a dot", ('"parts"',),
            {"primitive": None, "mesh": "assets/egg.glb"}),
        Key("primitive", "`sphere`, `cube`, `cylinder`, `cone`, `torus`, `plane` or `grid`", "none", "", '"torus"',
            "around the origin, with the sizes below", ('"ball"', "1")),
        Key("points", "path of a ply, pts, pwn or xyz file", "none", "", '"assets/moebius.ply"',
            "a disc (surfel) for each point, across its normal", ('"missing.ply"', "1"), {"primitive": None}),
    )),
    Section("`[[object]]`: sizes of a primitive", "scene", "object", "", (
        Key("radius", "number above 0", "see below", ITEM, "0.7", "of sphere, cylinder, cone; of a torus to the middle "
            "of its tube", ("0", "-1")),
        Key("height", "number above 0", "see below", ITEM, "2.0", "of cylinder and cone, along y", ("0",),
            {"primitive": "cone"}),
        Key("tube", "number above 0", "see below", ITEM, "0.12", "radius of a torus' tube", ("0",),
            {"primitive": "torus"}),
        Key("segments", _SEGMENTS, "see below", "", "128", "around; half as many from pole to pole",
            ("2", "4097", "3.0")),
        Key("size", "number above 0, or one for each edge: 3 of a cube, 2 of a plane or grid", "see below", ITEM,
            "[0.8, 0.5, 1.6]", "lengths of the edges", ("0", "[1, 1]"), {"primitive": "cube"}),
        Key("cells", "whole number, 1 to 4096, or two of them", "see below", "", "[8, 4]", "of a grid, along its edges",
            ("0", "4097", "[1, 2, 3]"), {"primitive": "grid"}),
    )),
    Section("`[[object]]`: discs of points", "scene", "object", "", (
        Key("radius", "number above 0", surfels, "mean distances to the nearest neighbour", "1.5", "of the discs",
            ("0",), {"primitive": None, "points": "assets/moebius.ply"}),
        Key("segments", "whole number, 3 to 64", surfels, "", "12", "corners of a disc", ("2", "65"),
            {"primitive": None, "points": "assets/moebius.ply"}),
    )),
    Section("`[[object]]`: place", "scene", "object", "", _PLACE),
    Section("`[[object]]`: look", "scene", "object", "", _LOOK),
    Section("Top of the file", "study", "", "", (
        Key("scene", "path of a scene file, relative to the study", "required", "", '"../three_spheres.toml"',
            "what is rendered", ('"missing.toml"', "1")),
        Key("method", "`least_squares`, `adam` or `lbfgs`",
            "`least_squares` where all parameters are few values and the loss is not `ssim`, else `adam`", "", '"adam"',
            "how parameters are found", ('"newton"',)),
        Key("loss", "`l2`, `l1`, `huber` or `ssim`; or a table of weights", Study, "", "{ l1 = 0.8, ssim = 0.2 }",
            "how far an image is from its reference, in linear light", ('"l3"', "{ l1 = -1 }", "{}")),
        Key("delta", "number above 0", Study, "linear light", "0.05", "where Huber's loss becomes linear", ("0", "-1")),
        Key("scales", "whole number, 1 to 64", Study, "", "3",
            "levels of the image pyramid that the loss is the mean over, down to a single pixel",
            ("0", "65", "1000000000")),
        Key("steps", "whole number, 1 to 10⁹", "100 (least squares, L-BFGS), 300 (Adam)", "", "200",
            "most evaluations (least squares) or iterations", ("0", "1000000001", "2.5")),
        Key("patience", "whole number, 1 to 10⁹", "50 (Adam), 3 (L-BFGS)", "steps", "20",
            "ends after so many steps without progress", ("0", "1000000001")),
        Key("tolerance", "number from 0", Study, "", "1e-6", "relative change that counts as none", ("-1",)),
        Key("learning_rate", "number above 0", Study, "", "0.05", "Adam's step", ("0", "-1")),
        Key("batch", "whole number, 1 to the number of views that are fitted", "all", "", "1",
            "views that Adam looks at in each step", ("0", "2"), {"method": "adam"}),
        Key("restarts", "whole number, 0 to 10,000", Study, "", "4",
            "further starts, drawn at random between the bounds; the best end counts", ("-1", "1000000000")),
        Key("seed", "whole number, 0 to 2⁶³ − 1", Study, "", "7", "of whatever is drawn at random",
            ("-1", "9223372036854775808")),
        Key("device", "`cpu`, `cuda` or `cuda:<number>`", Study, "", '"cpu"', "where torch and Warp compute",
            ('"gpu"', "1")),
        Key("checkpoint_seconds", "number from 0", Study, "seconds", "10.0", "between two checkpoints", ("-1",)),
        Key("resolve", "`sorted` or `kbuffer`", Study, "", '"kbuffer"',
            "`kbuffer` takes fragments as they come, into as many slots as there are layers; then beta plays no part",
            ('"stack"',), {"merge": "order_independent", "parameters": {"ball": {"thickness": 0.2}}}),
        Key("size", "as in `[camera]`", "the cameras' own", "pixels", "[256, 256]", "width and height of every image",
            ("[0, 5]", "[65536, 65536]")),
        *(Key(key.name, key.value, "the scene's", key.unit, key.example, f"in place of the scene's `{key.name}`",
              key.refused) for key in _OPTIONS),
    )),
    Section("`[reference]`", "study", "reference",
        "One of `image` and `true`; not needed where every view has its own.", (
        Key("image", "path of a PNG, JPEG, OpenEXR or npy image, relative to the study", "none", "", '"photo.png"',
            "the image to approach, of the camera's size", ('"missing.png"', "1"), {"true": None}),
        Key("true", "table of parameters and values", "none", "", "{ beta = 0.5, ball.thickness = 0.15 }",
            "approaches a render of the scene with these values, and reports how far from them the fit ends",
            ("{ gamma = 1 }", "1")),
        Key("supersampling", "whole number, 1 to 64", "1", "", "4", "samples along each edge of a pixel, with `true`",
            ("0", "65")),
        *(Key(key.name, key.value, "the study's", key.unit, key.example, f"the reference's own `{key.name}`",
              key.refused) for key in _OPTIONS),
    )),
    Section("`[[view]]`", "study", "view", "Further cameras, in place of the scene's own; any number.", (
        Key("name", "text of letters, digits, `_` and `-`, one of its own", "`view_0`, `view_1`, …", "", '"left"',
            "names the folder of the view's images", ('""', '"a/b"')),
        Key("image", "path of an image", "that of `[reference]`", "", '"photo.png"', "what this view approaches",
            ('"missing.png"',)),
        Key("held_out", "true or false", View, "", "false", "whether it is only compared at the end", ("1",)),
        *(Key(key.name, key.value, "the scene's", key.unit, key.example, f"the view's own `{key.name}`", key.refused,
              key.beside) for key in _CAMERA),
    )),
    Section("`[parameters]`: what is fitted", "study", "parameters",
        "A name and where it starts, as in `beta = 0.9`, or a table of the following, as in `ball.thickness = { "
        "start = 0.4, lower = 0.01 }`.", (
        Key("start", 'number, list of numbers, `"#rrggbb"` or `"2P"`, as the parameter has it', "the scene's value",
            "the parameter's", "0.4", "where the fit starts", ('"high"', "true")),
        Key("lower", "number", "see below", "the parameter's", "0.01", "least value", ('"low"',)),
        Key("upper", "number", "see below", "the parameter's", "2.0", "largest value", ('"high"', "0.001")),
        Key("per", "`object`, `vertex`, `pixel` or `view`", "as the start is shaped", "", '"vertex"',
            "what there is a value for", ('"face"', '"view"')),
        Key("learning_rate", "number above 0", "the study's", "", "0.05", "Adam's step", ("0",)),
        Key("smoothness", "number from 0", FitParameter, "", "0.01",
            "weight of the squared differences of neighbours in what is fitted per pixel or vertex", ("-1",),
            {"per": "vertex"}),
        Key("levels", "whole number, 1 to 64; as many as the smallest image has", FitParameter, "", "3",
            "stages from coarse to fine of what is fitted per pixel", ("0", "65"), {"per": "pixel"}),
    )),
)  # fmt: skip
