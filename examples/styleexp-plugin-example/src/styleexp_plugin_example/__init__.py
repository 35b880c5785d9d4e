"""A plugin of styleexp: the renderer ``example_normals``."""
