"""What there is to see: camera, objects, their parameters, and all of it as flat arrays."""
