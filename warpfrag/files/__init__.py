"""Files: scenes, meshes, points and images, in and out."""
