"""Datasets to files and back: logs, surfaces and products as NetCDF or Zarr."""
