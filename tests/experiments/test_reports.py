"""Run and sweep pages without a browser: what they hold, from whole, damaged and missing runs."""

import base64
import gzip
import hashlib
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from styleexp.cli.report import main
from styleexp.experiments.reports import charts, glb, html, page, shown, sweep_page
from styleexp.inputs import shapes
from styleexp.inputs.meshes import edges_of, load_mesh, save_mesh, vertex_normals
from styleexp.runs import finding, reading
from styleexp.system.errors import UserError

EVIL = '<img src=x onerror="alert(1)">'


def unpack(content):
    """The JSON and the binary chunk of a GLB file."""
    magic, version, size, length, kind = struct.unpack("<4sIIII", content[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(content), 0x4E4F534A)
    binary = content[20 + length :]
    assert struct.unpack("<II", binary[:8]) == (len(binary) - 8, 0x004E4942)
    return json.loads(content[20 : 20 + length]), binary[8:]


def rows(scene, binary, accessor, kind, width):
    """An accessor's values (count, width)."""
    accessor = scene["accessors"][accessor]
    view = scene["bufferViews"][accessor["bufferView"]]
    raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    table = np.frombuffer(raw, kind)
    stride = view.get("byteStride", width * table.itemsize) // table.itemsize
    return table.reshape(-1, stride)[:, :width][: accessor["count"]]


def write_run(folder, overrides, *, loss=1.0, status="done", config=None, **metrics):
    """A run's folder, as far as the sweep's page reads it."""
    folder.mkdir(parents=True)
    record = {"schema": 1, "overrides": overrides, "config": config or {}}
    (folder / "run.json").write_text(json.dumps(record))
    told = {"status": status, "seconds": 12.0}
    if status == "failed":
        told = {"status": status, "reason": f"no such thing: {EVIL}"}
    (folder / "status.json").write_text(json.dumps(told))
    if status == "done":
        step = {"step": 1, "loss": loss, "loss_global": 1, "loss_local": 1, "seconds": 0.5}
        (folder / "metrics.jsonl").write_text(json.dumps(step | {"rms_displacement": 0.1}) + "\n")
        (folder / "metrics.json").write_text(json.dumps(metrics))
        (folder / "report.html").write_text("a page")


# ------------------------------------------------------------------------------------ GLB


def test_glb_holds_the_mesh_to_a_fraction_of_a_pixel():
    mesh = shapes.make("critter")
    vertices = mesh.vertices / np.abs(mesh.vertices).max()
    scene, binary = unpack(glb.glb(vertices, mesh.faces, 1.25, np.linspace(-1, 1, len(vertices))))
    primitive = scene["meshes"][glb.HEAT]["primitives"][0]
    stored = rows(scene, binary, primitive["attributes"]["POSITION"], np.int16, 3)
    back = stored / 32767 * scene["nodes"][glb.HEAT]["scale"][0]
    assert np.abs(back - vertices).max() <= 1.25 / 32767 / 2 * 1.01
    normals = rows(scene, binary, primitive["attributes"]["NORMAL"], np.int16, 3) / 32767
    assert np.abs(normals - vertex_normals(vertices, mesh.faces)).max() < 1e-4
    faces = rows(scene, binary, primitive["indices"], np.uint16, 1).reshape(-1, 3)
    assert np.array_equal(faces, mesh.faces)
    u = rows(scene, binary, primitive["attributes"]["TEXCOORD_0"], np.uint16, 2)[:, 0] / 65535
    assert np.abs(u - np.linspace(0, 1, len(vertices))).max() < 1e-4
    bounds = scene["accessors"][primitive["attributes"]["POSITION"]]
    assert bounds["min"] == stored.min(axis=0).tolist()
    assert bounds["max"] == stored.max(axis=0).tolist()


def test_edges_are_each_there_once():
    mesh = shapes.make("torus")
    edges = edges_of(mesh.faces)
    assert len(edges) == len(mesh.vertices) + len(mesh.faces)  # Euler: V - E + F = 0
    assert len({tuple(sorted(edge)) for edge in edges.tolist()}) == len(edges)
    assert edges_of(np.zeros((0, 3), np.int64)).shape == (0, 2)


def test_large_meshes_have_wide_indices_and_huge_ones_no_edges(monkeypatch):
    n = 70_000
    vertices = np.random.default_rng(0).uniform(-1, 1, (n, 3))
    faces = np.arange(n - n % 3).reshape(-1, 3)
    scene, binary = unpack(glb.glb(vertices, faces, 1.0))
    stored = rows(scene, binary, scene["meshes"][0]["primitives"][0]["indices"], np.uint32, 1)
    assert np.array_equal(stored.reshape(-1, 3), faces)
    assert len(scene["nodes"]) == 3
    monkeypatch.setattr(glb, "WIREFRAME_FACES", 100)
    assert len(unpack(glb.glb(vertices, faces, 1.0))[0]["nodes"]) == 2


def test_heat_map_runs_from_blue_over_white_to_red():
    inward, none, outward = glb.diverging(np.array([-1.0, 0.0, 1.0]))
    assert inward[2] > inward[0] + 0.3
    assert outward[0] > outward[2] + 0.3
    assert none.min() > 0.85
    assert np.ptp(none) < 0.05


# ------------------------------------------------------------------------------------ run page


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run's folder as the command leaves it, with a wicked name."""
    from styleexp.config.compose import compose
    from styleexp.experiments.execute import run

    folder = tmp_path_factory.mktemp("finished")
    torus = shapes.make("torus")
    source = folder / "<script>alert(1)<b>.obj"
    save_mesh(torus, torus.vertices, source)
    overrides = ["style=bubble", "method=robust", "profile=smoke", "encoder=vgg19_random"]
    config = compose(overrides)
    config.source.path = str(source)
    (folder / "run").mkdir()
    assert run(config, folder / "run", [f"source.path='{source}'", *overrides]) == 0
    return folder / "run"


def blocks(text):
    """The page's compressed data blocks by their id."""
    found = re.findall(r'<script type="text/plain" id="([^"]+)">([^<]*)</script>', text)
    return {name: gzip.decompress(base64.b64decode(content)) for name, content in found}


def test_every_finished_run_leaves_its_page(finished):
    text = (finished / "report.html").read_text()
    held = blocks(text)
    assert set(held) == {"viewer-code", "glb-source", "glb-style", "glb-result"}
    assert b"ModelViewerElement" in held["viewer-code"]
    scene, binary = unpack(held["glb-result"])
    primitive = scene["meshes"][0]["primitives"][0]
    stored = rows(scene, binary, primitive["attributes"]["POSITION"], np.int16, 3) / 32767
    result = load_mesh(finished / "result.obj")
    source = shapes.make("torus").vertices
    frame = (result.vertices - source.mean(axis=0)) / np.linalg.norm(
        source - source.mean(axis=0), axis=1
    ).max()
    assert np.abs(stored * scene["nodes"][0]["scale"][0] - frame).max() < 1e-4
    status = json.loads((finished / "status.json").read_text())
    assert f"<dd>{status['seconds']:.0f} s</dd>" in text
    assert re.search(
        r"<dt>asked for</dt><dd>[^<]*style=bubble [^<]*encoder=vgg19_random</dd>", text
    )
    assert "<dt>method</dt><dd>learned</dd>" in text
    assert "Apache License" in text


def test_a_page_names_the_method(tmp_path):
    def named(config):
        run = reading.Run(tmp_path, record={"config": config})
        return dict(page.facts(run, shown.Shown())).get("method")

    assert named({"baseline": {"name": "synthesis"}}) == "synthesis"
    assert named({"baseline": None}) == "learned"
    assert named({}) is None


def test_names_are_text_and_the_policy_knows_the_only_script(finished):
    text = (finished / "report.html").read_text()
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;b&gt; in the style of bubble" in text
    script = text[text.rindex("<script>") + 8 : text.rindex("</script>")]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src &#39;sha256-{digest}" in text or f"script-src 'sha256-{digest}" in text
    assert "default-src 'none'" in text
    outside = re.sub(r"<pre>.*?</pre>|<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', outside)


def test_page_from_the_folder_shows_the_same_meshes(finished):
    first = (finished / "report.html").read_text()
    again = page.rewrite(finished).read_text()
    assert blocks(again)["glb-source"] == blocks(first)["glb-source"]
    assert blocks(again)["glb-style"] == blocks(first)["glb-style"]
    one, other = (unpack(blocks(text)["glb-result"]) for text in (first, again))
    a, b = (
        rows(*each, each[0]["meshes"][0]["primitives"][0]["attributes"]["POSITION"], np.int16, 3)
        for each in (one, other)
    )
    assert np.abs(a.astype(int) - b).max() <= 1  # PLY holds single precision


def test_no_page_where_none_is_wanted(tmp_path):
    from styleexp.config.compose import compose
    from styleexp.experiments.execute import run

    overrides = [
        "style=bubble",
        "source=torus",
        "method=robust",
        "profile=smoke",
        "encoder=vgg19_random",
    ]
    overrides.append("report=false")
    assert run(compose(overrides), tmp_path, overrides) == 0
    assert (tmp_path / "result.glb").exists()
    assert not (tmp_path / "report.html").exists()


def test_a_source_that_has_changed_since_is_not_shown(finished, tmp_path):
    record = json.loads((finished / "run.json").read_text())
    record["assets"]["source"]["sha256"] = "0" * 64
    for name in ("result.ply", "status.json", "metrics.jsonl"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    (tmp_path / "run.json").write_text(json.dumps(record))
    text = page.rewrite(tmp_path).read_text()
    assert "has changed since the run began" in text
    assert set(blocks(text)) == {"viewer-code", "glb-style", "glb-result"}


def test_page_of_a_damaged_run_says_what_is_damaged(tmp_path):
    (tmp_path / "run.json").write_text("{")
    (tmp_path / "status.json").write_text('{"status": "failed", "reason": "no <b> memory"}')
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "lo')
    (tmp_path / "result.ply").write_bytes(b"ply\nnonsense")
    text = page.rewrite(tmp_path).read_text()
    assert "run.json cannot be read" in text
    assert "result.ply&#39; has an unterminated header" in text
    assert "1 damaged lines" in text
    assert "no &lt;b&gt; memory" in text
    assert 'class="state failed"' in text


def test_page_of_twenty_thousand_faces_is_far_below_eight_megabytes(tmp_path):
    count = 101  # a bumpy grid of 2 * 100² faces, wrapped around a sphere
    u, v = np.meshgrid(np.linspace(0, np.pi, count), np.linspace(0, 2 * np.pi, count))
    rng = np.random.default_rng(0)
    radius = 1 + 0.05 * rng.standard_normal(u.shape)  # noise compresses worse than any result
    vertices = np.stack(
        [radius * np.sin(u) * np.cos(v), radius * np.cos(u), radius * np.sin(u) * np.sin(v)], -1
    ).reshape(-1, 3)
    corner = np.arange(count * count).reshape(count, count)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1],
                                      corner[1:, 1:]))  # fmt: skip
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    shape = shown.Shape(vertices, faces)
    shows = shown.Shown(shape, shape, shape, radius.ravel() - 1)
    assert len(faces) == 20_000
    text = page.build(reading.read(tmp_path), shows)
    assert len(text.encode()) < 5e6


def test_heat_map_tells_most_vertices_apart_though_one_sticks_out():
    displacement = np.append(np.linspace(-0.1, 0.1, 999), 50.0)
    shows = shown.Shown(displacement=displacement)
    assert 0.09 < shows.reach < 0.11


def test_numbers_below_a_chart_leave_room_for_each_other():
    few, many = ["1", "5", "10"], [f"0.00{k}" for k in range(100, 114)]
    assert charts._thinned(few) == few
    assert charts._thinned([*few, "auto"]) == [*few, "auto"]  # names are all shown
    shown = charts._thinned(many)
    assert len(shown) == len(many)
    assert [each for each in shown if each] == many[::3]


def test_charts_leave_out_what_is_not_finite_and_escape_labels():
    nan = float("nan")
    chart = charts.line_chart("loss", "step", [(EVIL, [1, 2, 3], [1.0, nan, 3.0])])
    assert "nan" not in chart
    assert EVIL not in chart
    assert len(re.search(r'points="([^"]*)"', chart)[1].split()) == 2
    assert charts.line_chart("loss", "step", [("loss", [1], [nan])]) == ""
    dots = charts.dot_chart("m", "axis", [("a", [("r", 2.0), ("s", 2.0)]), (EVIL, [])])
    assert dots.count("<circle") == 2
    assert EVIL not in dots


@pytest.mark.parametrize("low", [0.0, 1.0, -3.0, 1e-9, 123456.0])
@pytest.mark.parametrize("span", [1e-7, 0.3, 1.0, 999.0])
def test_ticks_are_round_and_within_the_scale(low, span):
    ticks = charts._ticks(charts.Scale(low, low + span, 0, 1), 4)
    assert 2 <= len(ticks) <= 9
    assert all(low - span * 1e-6 <= tick <= low + span * (1 + 1e-6) for tick in ticks)


# ------------------------------------------------------------------------------------ sweep page


@pytest.fixture
def sweep(tmp_path):
    """Layers × σ with two seeds in one cell, one failed job, one that never began."""
    for number, (layers, sigma, seed) in enumerate(
        [("low", 2, 0), ("low", 2, 1), ("low", 10, 0), ("high", 2, 0), ("high", 10, 0)]
    ):
        given = [f"layers={layers}", f"field.sigma={sigma}", f"optim.seed={seed}", "profile=smoke"]
        failed = layers == "high" and sigma == 2
        if number < 4:
            write_run(
                tmp_path / str(number), given, loss=4.0 - number, style_distance=0.5 + number,
                status="failed" if failed else "done",
            )  # fmt: skip
    jobs = [[f"layers={a}", f"field.sigma={s}", f"optim.seed={k}", "profile=smoke"]
            for a, s, k in [("low", 2, 0), ("low", 2, 1), ("low", 10, 0), ("high", 2, 0),
                            ("high", 10, 0)]]  # fmt: skip
    (tmp_path / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    return tmp_path


def test_grid_has_failed_and_missing_cells_and_seeds_share_one(sweep):
    runs = finding.find(sweep)
    assert [run.status for run in runs] == ["done", "done", "done", "failed", "missing"]
    (only,) = sweep_page.split(sweep, runs)
    assert only.axes == {"layers": ["low", "high"], "field.sigma": ["2", "10"]}
    (grid,) = only.grids
    states = [[[run.status for run in cell.runs] for cell in cells] for _, cells in grid.rows]
    assert states == [[["done", "done"], ["done"]], [["failed"], ["missing"]]]
    text = sweep_page.write(sweep).read_text()
    assert EVIL not in text
    assert "no such thing: &lt;img" in text
    assert text.count('href="0/report.html"') == 1  # in the table; there is no picture to click
    assert "style_distance by layers" in text


def test_pictures_are_the_previews_own_views(tmp_path):
    from PIL import Image

    from styleexp.runs import previews

    shades = [
        [Image.new("L", (96, 96), 60 * row + 10 * view) for view in range(4)] for row in (0, 1, 2)
    ]
    sheet = previews.sheet([("source", shades[0]), ("style", shades[1]), ("result", shades[2])], 96)
    sheet.save(tmp_path / "preview.png")
    for row in (0, 1, 2):
        seen = [np.unique(np.asarray(view)).tolist() for view in html.views(tmp_path, row)]
        assert seen == [[60 * row + 10 * view] for view in range(4)]
    sheet.resize((100, 100)).save(tmp_path / "preview.png")
    assert html.views(tmp_path, 2) == []
    assert html.views(tmp_path / "nowhere", 2) == []


def test_axes_are_sorted_as_numbers_and_a_third_makes_sheets():
    def run(number, *given):
        return reading.Run(Path(f"s/{number}"), overrides=list(given))

    runs = [
        run(n, f"a={a}", f"b={b}", f"+c={c}", "hydra.x=1")
        for n, (a, b, c) in enumerate(
            (a, b, c) for a in (10, 9) for b in ("x", "y") for c in ("p", "q")
        )
    ]
    (only,) = sweep_page.split(Path("s"), runs[:-1])
    assert only.axes == {"a": ["9", "10"], "b": ["x", "y"], "c": ["p", "q"]}
    assert [grid.title for grid in only.grids] == ["c=p", "c=q"]
    empty = [cell for _, cells in only.grids[1].rows for cell in cells if not cell.runs]
    assert len(empty) == 1


def test_a_search_is_shown_best_first_and_without_a_grid(tmp_path):
    runs = []
    for number, match in enumerate((2.0, 4.5, 3.0, 1.0, 4.0, 3.5)):
        at = tmp_path / str(number)
        at.mkdir()
        (at / "metrics.json").write_text(json.dumps({"match": match}))
        given = [f"a={1 / (number + 3)}", f"b={number / 7}", f"c={number}"]
        runs.append(reading.Run(at, status="done", overrides=given))
    (only,) = sweep_page.split(tmp_path, runs)
    (grid,) = only.grids
    order = [cell.runs[0].folder.name for _, cells in grid.rows for cell in cells]
    assert order == ["1", "4", "5", "2", "0", "3"]
    assert only.axes["a"][-1] == "0.3333"
    assert sweep_page.title(tmp_path, [only]).endswith(": 6 trials of a, b, c")


def test_several_sweeps_keep_apart(tmp_path):
    write_run(tmp_path / "one" / "0", ["a=1"])
    write_run(tmp_path / "one" / "1", ["a=2"])
    write_run(tmp_path / "two" / "0", ["b=1"])
    sweeps = sweep_page.split(tmp_path, finding.find(tmp_path))
    assert [(s.name, s.axes) for s in sweeps] == [("one", {"a": ["1", "2"]}), ("two", {})]
    assert "two" in sweep_page.write(tmp_path).read_text()


def test_job_ten_follows_job_nine(tmp_path):
    for number in (10, 9, 1):
        write_run(tmp_path / str(number), [f"a={number}"])
    assert [run.folder.name for run in finding.find(tmp_path)] == ["1", "9", "10"]


def test_links_lead_to_folders_with_odd_names(tmp_path):
    write_run(tmp_path / "a#b ?" / "0", ["a=1"])
    text = sweep_page.write(tmp_path).read_text()
    assert 'href="a%23b%20%3F/0/report.html"' in text


def test_titles_say_what_differs(tmp_path):
    at = tmp_path / "layer_ablation" / "2026-01-31_12-00-00"
    for number, (sigma, seed) in enumerate([(1, 0), (1, 1), (5, 0)]):
        write_run(at / str(number), [f"field.sigma={sigma}", f"optim.seed={seed}"])
    text = sweep_page.write(at).read_text()
    told = "layer_ablation, 2026-01-31 12-00-00: field.sigma 1, 5; 2 seeds"
    assert f"<title>{told}</title>" in text
    assert 'data-text="0 done field.sigma=1 optim.seed=0 "' in text


# ------------------------------------------------------------------------------------ command


def test_an_experiments_folder_stands_for_its_newest_sweep(tmp_path, capsys):
    folder = tmp_path / "layer_ablation"
    names = ("2026-01-31_12-00-00", "2026-02-01_09-00-00", "2026-02-01_09-00-00_2", "other")
    for name in names:
        write_run(folder / name / "0", ["layers=low", "+experiment=layer_ablation"])
        jobs = [["layers=low", "+experiment=layer_ablation"]]
        (folder / name / "jobs.json").write_text(json.dumps({"jobs": jobs}))
    found = finding.sweeps_of_experiment(folder)
    assert [path.name for path in found] == list(names[:3])
    assert main([str(folder)]) == 0
    out, err = capsys.readouterr()
    assert out.strip() == str(folder / names[2] / "report.html")
    assert "has 3 sweeps; this is the newest, of 2026-02-01_09-00-00_2" in err
    folder.rename(tmp_path / "multirun")  # not an experiment's: all that is in it
    assert finding.sweeps_of_experiment(tmp_path / "multirun") == []
    assert main([str(tmp_path / "multirun")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "multirun" / "report.html")


def test_command_writes_the_page_and_prints_its_path(sweep, capsys):
    assert main([str(sweep)]) == 0
    assert capsys.readouterr().out.strip() == str(sweep / "report.html")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "there is no folder 'nowhere'"),
        (["."], "there is no run below"),
        (["study"], "give the folder with the runs"),
        (["study", "."], "there is no finished run"),
        (["study", "--analyse", "nothing.json"], "nothing.json"),
    ],
)
def test_command_refuses_with_one_sentence(arguments, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_one_sentence(sweep, capsys, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(html, "save", full)
    assert main([str(sweep)]) == 2
    assert "No space left" in capsys.readouterr().err


def test_help_loads_nothing_heavy():
    import subprocess
    import sys

    code = (
        "import sys; from styleexp.cli.report import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'jinja2', 'pandas', 'PIL') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")


def test_study_refuses_pairs_that_cannot_be_shown_whole(sweep):
    from styleexp.experiments.reports import study

    with pytest.raises(UserError, match="can't be rated"):
        study.write(sweep)
    assert not (sweep / "study.html").exists()
