"""Rendering backends: the contract in `base`, the default in `soft_raster`."""
