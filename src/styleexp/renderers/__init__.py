"""Rendering backends: the contract in `base`, the built-in ones by name in `specs`."""
