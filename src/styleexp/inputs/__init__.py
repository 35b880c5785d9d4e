"""Meshes and images: reading, writing, assets and analytic shapes."""
