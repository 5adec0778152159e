"""Depth of a mesh rendered by OpenGL: `python opengl_depth.py MESH_AND_CAMERA.npz DEPTH.npy`; exits 77 without OpenGL.

A process of its own, because Mesa's LLVM and that of torch's compiler do not get along in one (a segmentation fault).
"""

import os
import sys

import numpy as np

NO_OPENGL = 77


def main(source: str, target: str) -> None:
    """Render and write the planar depth, 0 where nothing is."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    os.environ["PYGLET_HEADLESS"] = "1"
    import pyrender
    import trimesh

    given = np.load(source)
    width, height = (int(size) for size in given["size"])
    focal, near, far = (float(given[name]) for name in ("focal", "near", "far"))
    # The depth that is read back from a multisampled buffer is that of sample 0, at (0.375, 0.875) of a pixel from its
    # upper left corner: the image is moved so that this place takes the pixel's centre.
    lens = pyrender.IntrinsicsCamera(focal, focal, width / 2 - 0.125, height / 2 + 0.375, znear=near, zfar=far)
    stage = pyrender.Scene()
    mesh = trimesh.Trimesh(given["vertices"], given["faces"], process=False)
    stage.add(pyrender.Mesh.from_trimesh(mesh, smooth=False))
    # OpenGL's axes: x right, y up, z backward.
    stage.add(lens, pose=np.linalg.inv(np.diag([1.0, -1.0, -1.0, 1.0]) @ given["view"]))
    try:
        renderer = pyrender.OffscreenRenderer(width, height)
    except Exception as error:
        print(error, file=sys.stderr)
        sys.exit(NO_OPENGL)
    flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
    np.save(target, renderer.render(stage, flags=flags)[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
