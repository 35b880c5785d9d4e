"""A plugin of styleexp: a renderer, a loss and a field."""
