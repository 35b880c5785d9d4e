"""``python -m styleexp.cli.studio``."""

import sys

from styleexp.cli.studio import main

sys.exit(main())
