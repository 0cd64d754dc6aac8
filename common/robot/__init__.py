"""Robots as data: an MJCF model and a TOML table each, and the kinematic chain that the kernels take as a value."""
