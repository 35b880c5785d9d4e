"""``python -m styleexp``."""

from styleexp.cli.main import main

main()
