"""styleexp."""
