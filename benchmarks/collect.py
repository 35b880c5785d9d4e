"""Time the collection of a thousand run folders: python benchmarks/collect.py"""

import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from styleexp.config.compose import compose
from styleexp.experiments.reports import collect
from styleexp.experiments.reports.collect import write

RUNS, STEPS = 1000, 160

with tempfile.TemporaryDirectory() as name:
    config = asdict(compose(["source=torus", "style=bubble"]))
    record = json.dumps({"config": config, "versions": {"torch": "2"}, "assets": {}})
    lines = "".join(json.dumps({"step": n, "loss": 1 / n}) + "\n" for n in range(1, STEPS + 1))
    for number in range(RUNS):
        folder = Path(name) / str(number)
        folder.mkdir()
        (folder / "run.json").write_text(record)
        (folder / "status.json").write_text('{"status": "done", "seconds": 60.0}')
        (folder / "metrics.jsonl").write_text(lines)
    begun = time.perf_counter()
    frame = collect(name)
    collected = time.perf_counter()
    write(frame, name)
    written = time.perf_counter()
print(
    f"{len(frame)} runs, {len(frame.columns)} columns: collected in {collected - begun:.1f} s, "
    f"written in {written - collected:.1f} s"
)
