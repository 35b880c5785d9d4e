"""The commands, one small file each."""

import os

# Read when torch loads. OpenMP threads that spin for as long as they wait made a 28 ms render take
# 3 s on two busy cores; threads that sleep at once make a step 1.1 to 1.2 times as long on two free
# ones, for it takes longer to wake them than most work takes. So: spin briefly, then sleep. The
# count is read by GNU's OpenMP, which torch brings on Linux.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "3000")
