"""Several runs at once: Hydra's sweeps, plans of experiments, their tables and figures."""
