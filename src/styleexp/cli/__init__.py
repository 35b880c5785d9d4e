"""The commands, one small file each."""

import os

# Read when torch loads. OpenMP threads that spin while waiting made a 28 ms render take 3 s on two
# busy cores; threads that sleep immediately make a step 1.1 to 1.2 times as long on two idle cores,
# because waking them takes longer than most work. So: spin briefly, then sleep. The count is read
# by GNU OpenMP, which torch ships on Linux.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "3000")
