"""Files, locks, processes, progress and errors; needs only the standard library."""
