"""Studies: what they write, all of them run together, and their report."""
