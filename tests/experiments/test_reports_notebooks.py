"""The notebooks, executed on runs whose numbers are known."""

import json
import math
import re

import numpy as np
import pytest

from styleexp.cli.report import main
from styleexp.inputs import shapes
from styleexp.inputs.meshes import save_mesh, vertex_normals
from styleexp.system.errors import UserError

pytest.importorskip("pandas", reason="pandas is not installed (extra report)")
from styleexp.experiments.reports import notebook, notebooks

SMOOTH = {"silhouette_iou": 0.99, "craft": 4.0, "relief_rms": 0.01, "style_distance": 0.5}


def write_run(folder, overrides, steps=200, **measured):
    """A finished run's folder with a real mesh and real pictures."""
    from PIL import Image

    folder.mkdir(parents=True)
    given = dict(each.lstrip("+").split("=") for each in overrides)
    config = {
        "source": {"name": given.get("source", "torus"), "path": None},
        "style": {"name": given.get("style", "bubble"), "path": None},
        "optim": {"steps": steps},
        "encoder": {"name": "vgg16"},
    }
    record = {"schema": 1, "overrides": overrides, "config": config, "versions": {"torch": "2"}}
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "status.json").write_text('{"status": "done", "seconds": 60.0}')
    (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 1.5, "seconds": 0.1}\n')
    (folder / "metrics.json").write_text(json.dumps(SMOOTH | measured))
    Image.new("L", (48, 48), 128).save(folder / "turntable.gif")
    Image.new("L", (4 * 48, 3 * (48 + 18)), 200).save(folder / "preview.png")
    torus = shapes.make("torus")
    height = 0.01 * np.sin(5 * torus.vertices[:, 0])
    moved = torus.vertices + height[:, None] * vertex_normals(torus.vertices, torus.faces)
    save_mesh(torus, moved, folder / "result.ply", height)


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    """Runs of every experiment that a notebook is for."""
    folder = tmp_path_factory.mktemp("paper")

    def write(experiment, number, *overrides, **measured):
        given = [f"+experiment={experiment}", *overrides]
        write_run(folder / experiment / str(number), given, **measured)

    layers = {
        "low": (0.80, 0.020, 0.4),
        "mixed": (0.95, 0.010, 0.3),
        "high_vgg16": (0.99, 0.02, 0.9),
    }
    for number, (name, (kept, height, apart)) in enumerate(layers.items()):
        write("layer_ablation", number, f"layers={name}", silhouette_iou=kept, relief_rms=height,
              style_distance=apart)  # fmt: skip
    for number, sigma in enumerate((1, 5, 10)):
        write("sigma_ablation", number, f"field.sigma={sigma}", relief_rms=0.001 * sigma)
    for number, style in enumerate(("scales", "wave_small")):
        write("mesh_styles", number, f"style={style}", style_distance=0.5 + number)
    for number, name in enumerate(("robust", "vertex")):
        write("baselines_mesh", number, f"method={name}", style_distance=0.4 + 0.1 * number)
    for number, (name, seed) in enumerate(
        (a, b) for a in ("soft_raster", "mitsuba_ad") for b in "01"
    ):
        write("renderer_ablation", number, f"renderer={name}", f"optim.seed={seed}",
              style_distance=0.4 + 0.1 * int(seed) + 0.01 * (name == "mitsuba_ad"))  # fmt: skip
    for number, name in enumerate(("robust", "paper", "mask")):
        write("method_ablation", number, f"+switch={name}", style_distance=0.4 + 0.1 * number)
    write("board", 0, "+pair=torus_bubble")
    return folder


@pytest.fixture(scope="module")
def executed(paper):
    """What the command prints; everything was executed once."""
    import contextlib
    import io

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main([str(paper), "--notebooks"]) == 0, err.getvalue()
    return out.getvalue(), err.getvalue()


def claims(page):
    """What a page's last table says: whether each claim holds, by the claim."""
    rows = re.findall(r"<tr>\s*<td>(.*?)</td>\s*<td>(.*?)</td>\s*<td>(.*?)</td>\s*</tr>", page)
    return {paper: (ours, verdict) for paper, ours, verdict in rows}


def test_every_notebook_runs_and_asks_for_nothing(paper, executed):
    printed = executed[0].split()
    assert [path.rsplit("/", 1)[1] for path in printed] == [
        f"{n}.html" for n in notebooks.NOTEBOOKS
    ]
    for name in notebooks.NOTEBOOKS:
        page = (paper / "notebooks" / f"{name}.html").read_text()
        outside = re.findall(r"""(?:src|href)=["'](?:https?:)?//[^"']*|import\(["']http""", page)
        assert outside == []
        cells = json.loads((paper / "notebooks" / f"{name}.ipynb").read_text())["cells"]
        assert not [o for c in cells for o in c.get("outputs", []) if o["output_type"] == "error"]
        if name != "appendix":
            assert "data:image/png;base64" in page, name


def test_claims_are_told_by_the_numbers(paper, executed):
    layers = claims((paper / "notebooks" / "layer_ablation.html").read_text())
    assert layers["with low layers the source is significantly distorted"] == (
        "silhouette IoU with the source: low 0.8, mixed 0.95",
        "yes",
    )
    assert (
        layers["with high layers the undulation of the surface is not clearly visible"][1] == "no"
    )
    assert layers["mixed layers learn the style better than low ones"][1] == "yes"
    sigma = claims((paper / "notebooks" / "sigma_ablation.html").read_text())
    assert sigma["a larger σ makes the style more pronounced"][1] == "yes"
    assert sigma["a larger σ gives details of higher frequency"][1] == "no"  # the same mesh thrice
    styles = claims((paper / "notebooks" / "styles.html").read_text())
    assert [verdict for _, verdict in styles.values()] == ["no", "yes"]
    baselines = claims((paper / "notebooks" / "baselines.html").read_text())
    assert [verdict for _, verdict in baselines.values()] == ["yes"]
    backends = claims((paper / "notebooks" / "backends.html").read_text())
    assert next(iter(backends.values()))[1] == "yes"
    board = claims((paper / "notebooks" / "board.html").read_text())
    assert {verdict for _, verdict in board.values()} == {"can't be told"}


def test_tables_are_there_for_papers(paper, executed):
    tables = paper / "notebooks"
    text = (tables / "appendix_layer_ablation.tex").read_text()
    assert text.startswith(r"\begin{tabular}")
    assert r"style\_distance" in text
    assert "high\\_vgg16" in text
    csv = (tables / "layer_ablation.csv").read_text()
    assert csv.count("\n") == 4
    assert "0.95" in csv


def test_latex_is_escaped_and_numbers_are_short():
    import pandas

    frame = pandas.DataFrame({"a_b": ["50 % & \\x", "y^2"], "n": [1 / 3, math.nan]})
    lines = notebook.latex(frame).splitlines()
    assert lines[0] == r"\begin{tabular}{lr}"
    assert lines[2] == r"a\_b & n \\"
    assert lines[4] == r"50 \% \& \textbackslash{}x & 0.3333 \\"
    assert lines[5] == r"y\textasciicircum{}2 & -- \\"


def test_slope_of_a_known_relief(tmp_path):
    torus = shapes.make("torus")
    height = 0.3 * torus.vertices[:, 1]
    save_mesh(torus, torus.vertices, tmp_path / "result.ply", height)
    edges = np.unique(np.sort(torus.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    along = torus.vertices[edges[:, 0]] - torus.vertices[edges[:, 1]]
    expected = 0.3 * np.abs(along[:, 1]) / np.linalg.norm(along, axis=1)
    found = notebook.slope(tmp_path)
    assert found == pytest.approx(np.sqrt(np.square(expected).mean()), rel=1e-4)
    assert math.isnan(notebook.slope(tmp_path / "nowhere"))


def test_missing_and_unmeasured_runs_are_said_to_be_so(tmp_path):
    for number, name in enumerate(("low", "mixed")):
        write_run(tmp_path / "layer_ablation" / str(number), [f"layers={name}"], steps=4)
    jobs = [["layers=low"], ["layers=mixed"], ["layers=high_vgg16"]]
    (tmp_path / "layer_ablation" / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    frame = notebook.runs(tmp_path, "layer_ablation")
    assert list(frame["status"]) == ["done", "done", "missing"]
    told = notebook.caution(frame)
    assert "1 of 3 runs are not finished: 1 missing" in told
    assert "4 steps" in told
    assert math.isnan(notebook.mean(frame, "style_distance", axis__layers="high_vgg16"))
    claim = notebook.smaller("a", ("x", math.nan), ("y", 1.0), "z")
    assert claim.holds is None
    with pytest.raises(UserError, match="no run of board"):
        notebook.runs(tmp_path, "board")


def test_notebooks_without_runs_are_left_out_and_a_failure_is_one_sentence(tmp_path, capsys):
    write_run(tmp_path / "layer_ablation" / "0", ["layers=low"])
    written, left_out = notebooks.execute(tmp_path, ["layer_ablation", "board"])
    assert [path.name for path in written] == ["layer_ablation.html"]
    assert left_out == [f"board was left out: there is no run of board below '{tmp_path}'."]
    (tmp_path / "sigma_ablation").mkdir()
    write_run(tmp_path / "sigma_ablation" / "0", ["field.sigma=fine"])
    write_run(tmp_path / "sigma_ablation" / "1", ["field.sigma=coarse"])
    assert main([str(tmp_path), "--notebooks", "sigma_ablation"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "the notebook 'sigma_ablation' failed (ValueError: could not convert" in lines[0]
    assert not list((tmp_path / "notebooks").glob("sigma*"))
    assert main([str(tmp_path), "--notebooks", "layers"]) == 2
    assert "did you mean 'layer_ablation'" in capsys.readouterr().err


def test_a_plan_of_pairs_half_done_has_one_column_of_pairs(tmp_path):
    pairs = ("torus_bubble", "sphere_stripe", "hand_wave_large")
    given = {pair: [f"+pair={pair}", "+experiment=board"] for pair in pairs}
    for pair in pairs[:2]:
        given[pair] += _parts(pair)
        write_run(tmp_path / "board" / pair, given[pair])
    jobs = {f"board/{pair}": {"state": "missing", "overrides": given[pair]} for pair in pairs}
    (tmp_path / "manifest.json").write_text(json.dumps({"schema": 1, "jobs": jobs}))
    frame = notebook.runs(tmp_path, "board")
    assert sorted(frame["pair"]) == ["hand-wave_large", "sphere-stripe", "torus-bubble"]
    table = notebook.table(frame, ["style_distance"])
    assert len(set(table)) == len(list(table))
    assert notebook.latex(table).count("torus-bubble") == 1
    page = notebook.show(table).data
    assert "0.5</td>" in page
    assert "–</td>" in page  # of the one that never began
    assert "<dt>style_distance</dt>" in page
    assert notebook.triples(frame).data.startswith(b"\x89PNG")


def _parts(pair):
    source, _, style = pair.partition("_")
    return [f"source={source}", f"style={style}"]
