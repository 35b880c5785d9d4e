"""Hydra's configuration files, packaged."""
