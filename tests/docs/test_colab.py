"""The notebook for Colab runs, but for what only Colab has."""

import json
import os
import subprocess
import sys

from tests.helpers import ROOT, warm


def test_its_cells_run_in_order(tmp_path):
    notebook = json.loads((ROOT / "examples" / "colab.ipynb").read_text())
    cells = [each for each in notebook["cells"] if each["cell_type"] == "code"]
    assert cells[0]["metadata"]["tags"] == ["install"]
    lines = ["import sys, types"]
    # Without IPython: what it would show is only made.
    lines += ["sys.modules['IPython'] = types.ModuleType('IPython')"]
    lines += ["sys.modules['IPython.display'] = shown = types.ModuleType('IPython.display')"]
    lines += ["shown.Image = lambda name: open(name, 'rb').read()"]
    for cell in cells[1:]:
        assert not cell["outputs"]
        lines.append("".join(cell["source"]).replace('"strength=1"', '"source.refine=none"'))
    script = tmp_path / "cells.py"
    script.write_text("\n".join(lines).replace('.show(viewer="notebook")', ".bounds"))
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=warm.coarse(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert {"result.glb", "preview.png"} <= set(os.listdir(tmp_path))
