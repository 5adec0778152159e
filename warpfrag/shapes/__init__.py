"""Shapes: meshes, primitives and surfels."""
