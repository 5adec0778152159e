"""Exact merging: all slabs of a pixel at once."""
