"""Inject faults into runs, sweeps, caches and downloads, and write their table in
docs/robustness.md.

    python -m benchmarks.faults                     # all, half an hour on one idle core
    python -m benchmarks.faults --only damaged      # those with this word in their name
    python -m benchmarks.faults --times 2 --seed 7  # fewer trials, other moments
    python -m benchmarks.faults --seconds 600       # begin no trial after so long

Exits with code 1 if a fault lost data. Only rows of tested faults are replaced in the table. Full
disks and frozen folders are real and need root; clock jumps need Debian's package faketime;
untestable faults are listed.
"""

from __future__ import annotations

import argparse
import random
import re
import shutil
import sys
import tempfile
import time
import traceback
from pathlib import Path

from tests.helpers import ROOT

PAGE = ROOT / "docs" / "robustness.md"
BEGIN, END = "<!-- begin: benchmarks/faults.py -->\n", "<!-- end: benchmarks/faults.py -->\n"
HEAD = "| fault | tried | survived | lost | what the user sees |\n" + "| --- " * 5 + "|\n"


def main() -> int:
    """Inject the faults and write the table."""
    from tests.helpers.fault_trials import FAULTS, Missing, Stage

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults with this in their name")
    parser.add_argument("--times", type=int, help="trials of each fault; default: each its own")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no trial later")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    begun, lost_in_all, rows = time.perf_counter(), 0, {}
    folder = Path(tempfile.mkdtemp(prefix="styleexp-faults-"))
    try:
        stage = Stage(folder)
        for name, fault in FAULTS.items():
            if options.only not in name:
                continue
            tried = lost = 0
            said = ""
            # Each fault has its own chance, so that one alone meets the same moments.
            chance = random.Random(f"{options.seed} {name}")
            while tried < (options.times or fault.times):
                if time.perf_counter() - begun > options.seconds:
                    break
                try:
                    count, said = fault.tried(stage, chance)
                    tried += count
                except Missing as missing:
                    print(f"{name}: not tried: {missing}", flush=True)
                    break
                except Exception:
                    tried, lost = tried + 1, lost + 1
                    traceback.print_exc()
                    stage.tidy()
            if tried:
                rows[name] = f"| {name} | {tried} | {tried - lost} | {lost} | {_cell(said)} |\n"
                print(rows[name], end="", flush=True)
            lost_in_all += lost
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8"), rows), encoding="utf-8")
    print(f"{time.perf_counter() - begun:.0f} s; wrote {PAGE.relative_to(ROOT)}")
    return int(lost_in_all > 0)


def page(text: str, rows: dict[str, str]) -> str:
    """The page with these rows updated."""
    from tests.helpers.fault_trials import FAULTS

    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    old = {line.split(" | ")[0].removeprefix("| "): line for line in text[start:end].splitlines()}
    kept = {name: f"{old[name]}\n" for name in FAULTS if name in old}
    rows = {**kept, **rows}
    return text[:start] + "\n" + HEAD + "".join(rows[n] for n in FAULTS if n in rows) + text[end:]


def _cell(said: str) -> str:
    said = re.sub(r"0\.\d{6,}|told-\d+", "…", said)
    return said.replace("|", "\\|").replace("<", "&lt;").replace(">", "&gt;").replace("*", "\\*")


if __name__ == "__main__":
    sys.exit(main())
