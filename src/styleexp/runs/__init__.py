"""A run's folder: identity, files, reading back, previews and baking."""
