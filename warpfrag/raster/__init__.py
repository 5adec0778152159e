"""Rays, triangles, and the walk over the pixels that triangles cover."""
