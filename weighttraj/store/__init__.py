"""Bytes of runs and data sets. Only this room knows Zarr and h5py (and ``tools.hdf5``)."""
