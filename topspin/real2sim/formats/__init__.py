"""Files of recorded balls: states and tracks in the world frame and SI.

HDF5 needs h5py, of the extra ``real2sim``: ``pip install -e '.[real2sim]'``.
"""
