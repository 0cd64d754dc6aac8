"""From recordings of real balls to simulated ones: read them, fit launch and spin to them, play them again.

Needs the extra ``real2sim`` (scipy to fit, h5py for HDF5): ``pip install -e '.[real2sim]'``.
"""
