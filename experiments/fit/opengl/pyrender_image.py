"""Flat-coloured faces rendered by pyrender: `python pyrender_image.py SCENE.npz IMAGE.npy`; exits 77 without OpenGL.

A process of its own, because Mesa's LLVM and that of torch's compiler do not get along in one (a segmentation fault).

pyrender's flat shading writes colours as they are, 8 bits each and not converted to sRGB. Linear colours of 16 bits are
rendered in two passes, high bytes and low bytes. Its own multisampling would mix neighbouring samples before they are
put together, and elsewhere than at pixel centres: it is turned off.
"""

import os
import sys
from typing import Any

import numpy as np

NO_OPENGL = 77


def main(source: str, target: str) -> None:
    """Render to linear colours, (H, W, 3) float32."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    os.environ["PYGLET_HEADLESS"] = "1"
    try:
        import pyrender
    # Beside ImportError, PyOpenGL has its own for libraries that it cannot load.
    except Exception as error:
        leave(error)
    single_sampled(pyrender)
    given = np.load(source)
    width, height = (int(size) for size in given["size"])
    focal, near, far = (float(given[name]) for name in ("focal", "near", "far"))
    levels = np.rint(65535.0 * np.clip(given["colors"], 0.0, 1.0)).astype(np.uint16)
    back = np.rint(65535.0 * given["background"]).astype(np.uint16)
    try:
        renderer = pyrender.OffscreenRenderer(width, height)
    except Exception as error:
        leave(error)
    flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
    image = np.zeros((height, width, 3), np.uint16)
    for shift in (8, 0):
        stage = pyrender.Scene(bg_color=((back >> shift) & 255) / 255.0)
        colors = np.repeat(((levels >> shift) & 255).astype(np.uint8), 3, axis=0)
        # Three corners of its own for every face, all of one colour.
        corners = given["triangles"].reshape(-1, 3).astype(np.float32)
        colors = np.concatenate([colors / np.float32(255.0), np.ones((len(colors), 1), np.float32)], axis=1)
        part = pyrender.Primitive(corners, color_0=colors, mode=4)
        stage.add(pyrender.Mesh([part]))
        lens = pyrender.IntrinsicsCamera(focal, focal, width / 2, height / 2, znear=near, zfar=far)
        # OpenGL's axes: x right, y up, z backward.
        stage.add(lens, pose=np.linalg.inv(np.diag([1.0, -1.0, -1.0, 1.0]) @ given["view"]))
        image |= renderer.render(stage, flags=flags)[0].astype(np.uint16) << shift
    np.save(target, (image / 65535.0).astype(np.float32))


def single_sampled(pyrender: Any) -> None:
    """Take the samples out of pyrender's multisampled storage: 0 of them is one, at the pixel's centre."""
    module = sys.modules["pyrender.renderer"]
    storage = module.glRenderbufferStorageMultisample
    module.glRenderbufferStorageMultisample = lambda target, samples, *rest: storage(target, 0, *rest)


def leave(error: Exception) -> None:
    """Say what is missing, and exit."""
    print(error, file=sys.stderr)
    sys.exit(NO_OPENGL)


if __name__ == "__main__":
    main(*sys.argv[1:])
