"""Property tests of this folder: the same examples in every run, no deadline (a first call compiles)."""

from hypothesis import settings

settings.register_profile("kernels", deadline=None, derandomize=True)
settings.load_profile("kernels")
