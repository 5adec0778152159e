"""The mathematics of slabs: each formula above its adjoint."""
