"""The command as a user meets it: real processes, real folders."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import styleexp
from tests.helpers import warm

SMOKE = ["method=robust", "profile=smoke", "encoder=vgg19_random"]


def command(*arguments, cwd, env=None):
    """Run `styleexp` and return the finished process."""
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=env or warm.coarse())


def fresh_command(*arguments, cwd, **more):
    """The same, in an interpreter that starts anew: where that is what the test is about."""
    return subprocess.run(
        [sys.executable, "-m", "styleexp", *arguments],
        cwd=cwd, capture_output=True, text=True, timeout=300, check=False, **more,
    )  # fmt: skip


def complaint(done):
    """The one line on standard error of a refused command."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    beside = ("warning: ", "downloading the weights ")  # where the cache is still empty
    lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith(beside)]
    assert len(lines) == 1, done.stderr
    return lines[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run's folder, shared by the tests that only look at it."""
    cwd = tmp_path_factory.mktemp("finished")
    done = command("source=torus", "style=bubble", *SMOKE, "hydra.run.dir=run", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd / "run", done


def test_run_leaves_everything(finished):
    folder, done = finished
    names = {p.name for p in folder.iterdir()}
    assert {
        "status.json", "run.json", "metrics.jsonl", "checkpoint.safetensors", "preview.png",
        "turntable.gif", "result.ply", "result.obj", "result.glb",
    } <= names  # fmt: skip
    assert not [n for n in names if "partial" in n]
    assert json.loads((folder / "status.json").read_text())["status"] == "done"
    steps = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [s["step"] for s in steps] == [1, 2, 3, 4]
    record = json.loads((folder / "run.json").read_text())
    assert record["config"]["optim"]["steps"] == 4
    assert record["versions"]["torch"]
    assert record["device"] == "cpu"
    assert str(folder / "result.glb") in done.stdout or "run/result.glb" in done.stdout


def test_ply_carries_the_displacement(finished):
    header = (finished[0] / "result.ply").read_bytes()[:600].decode("latin-1")
    assert "displacement" in header


def test_kill_and_resume_is_bit_identical(finished, tmp_path):
    folder = tmp_path / "killed"
    arguments = ["source=torus", "style=bubble", *SMOKE, "optim.steps=30"]
    arguments.append(f"hydra.run.dir={folder}")
    undisturbed = tmp_path / "whole"
    assert command(*arguments[:-1], f"hydra.run.dir={undisturbed}", cwd=tmp_path).returncode == 0
    process = warm.start("-m", "styleexp", *arguments, cwd=tmp_path, env=warm.coarse())
    lines = folder / "metrics.jsonl"
    deadline = time.monotonic() + 240
    while not (lines.exists() and lines.read_text().count("\n") >= 5):
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert json.loads((folder / "status.json").read_text())["status"] == "running"
    assert not (folder / "result.ply").exists()

    done = command(f"resume={folder}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "resuming at step" in done.stdout
    for name in ("result.ply", "result.obj"):
        assert (folder / name).read_bytes() == (undisturbed / name).read_bytes()
    steps = [json.loads(line)["step"] for line in lines.read_text().splitlines()]
    assert steps == list(range(1, 31))


def test_interrupt_checkpoints_and_says_how_to_go_on(tmp_path):
    folder = tmp_path / "run"
    process = warm.start(
        "-m", "styleexp", "source=torus", "style=bubble", *SMOKE, "optim.steps=400",
        f"hydra.run.dir={folder}", cwd=tmp_path, env=warm.coarse(), stdout=warm.PIPE,
    )  # fmt: skip
    lines = folder / "metrics.jsonl"
    deadline = time.monotonic() + 240
    while not lines.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    told, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert f"styleexp resume={folder}" in told
    status = json.loads((folder / "status.json").read_text())
    assert status["status"] == "interrupted"
    assert (folder / "checkpoint.safetensors").exists()
    assert f"styleexp resume={folder}" in (folder / "report.html").read_text()


def test_an_interrupted_synthesis_says_how_to_run_it_again(tmp_path):
    folder = tmp_path / "run"
    process = warm.start(
        "-m", "styleexp", "torus", "bubble", "source.refine=150000", "report=false",
        f"hydra.run.dir={folder}", cwd=tmp_path, env=warm.coarse(), stdout=warm.PIPE,
        stderr=warm.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    assert any("wavelength" in line for line in process.stdout)  # it is at work
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=300)
    assert process.returncode == 130
    assert f"stopped; rerun with: styleexp resume={folder}" in told
    assert json.loads((folder / "status.json").read_text())["status"] == "interrupted"
    assert not (folder / "result.ply").exists()


def test_damaged_checkpoint_falls_back_to_the_one_before_and_says_so(finished, tmp_path):
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(finished[0], folder)
    checkpoint = folder / "checkpoint.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    done = command(f"resume={folder}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "is damaged" in done.stdout
    assert (folder / "result.ply").read_bytes() == (finished[0] / "result.ply").read_bytes()


def test_what_another_run_left_unfinished_is_not_replaced_without_a_word(finished, tmp_path):
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(finished[0], folder)
    (folder / "status.json").write_text(json.dumps({"status": "interrupted"}))
    given = ["source=torus", "style=bubble", *SMOKE, "hydra.run.dir=run", "report=false"]
    done = command(*given, "optim.steps=3", "preview.turntable_frames=1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "which had other settings, files or another version" in done.stdout


def test_a_refused_command_costs_no_result_that_is_there(finished, tmp_path):
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(finished[0], folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    (tmp_path / "junk.obj").write_text("v 0 0 0\nf 1 2 3\n")
    done = command("junk.obj", "bubble", *SMOKE, "hydra.run.dir=run", cwd=tmp_path)
    assert "junk.obj" in complaint(done)
    assert {name: (folder / name).read_bytes() for name in before} == before


def test_resume_refuses_what_is_no_run(tmp_path):
    assert "no run.json" in complaint(command(f"resume={tmp_path}", cwd=tmp_path))
    twice = command(f"resume={tmp_path}", f"resume={tmp_path}", cwd=tmp_path)
    assert "give it once" in complaint(twice)
    told = complaint(command(f"resume={tmp_path}", "optim.steps=9", cwd=tmp_path))
    assert "optim.steps=9" in told


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["source=crittr", "style=bubble"], "did you mean 'critter'"),
        (["source=critter", "style=buble"], "did you mean 'bubble'"),
        (["source=critter"], "no style was given"),
        ([], "no source was given"),
        (["source=critter", "style=bubble", "optim.stps=3"], "optim.steps"),
        (
            ["source=critter", "style=bubble", "optim.steps=many"],
            "steps must be a whole number, not 'many'",
        ),
        (["source=critter", "style=bubble", "style.siz=2"], "only direction, falloff"),
        (["source=critter", "style=bubble", "renderer=kaolin"], "unknown renderer"),
        (["source.path=nowhere.obj", "style=bubble"], "nowhere.obj"),
        (["source=critter", "style.path=nowhere.png"], "nowhere.png"),
        (["source=critter", "style=bubble", "device=cuda:7"], "cuda:7"),
        (["source=critter", "style=bubble", "loss.layers=[conv9_9]"], "conv9_9"),
        (["source=critter", "style=bubble", "views.local.mode=sideways"], "sideways"),
        (["source=critter", "style=bubble", "shading.background=mauve"], "mauve"),
        (["source=critter", "style=bubble", "optim.steps=0"], "optim.steps"),
        (["source=critter", "style=bubble", "style.scale=0"], "style.scale"),
        (["source=critter", "style=bubble", "views.count=0"], "views.count"),
        (["source=critter", "style=bubble", "field.sigma=-1"], "field.sigma"),
        (["source=critter", "style=bubble", "loss.block_weights=[1,2]"], "block_weights"),
        (["source=critter", "style=bubble", "style"], "style"),
    ],
)
def test_mistakes_get_one_sentence(arguments, expected, tmp_path):
    done = command(*arguments, *SMOKE, "hydra.run.dir=run", cwd=tmp_path)
    assert expected in complaint(done)
    assert not (tmp_path / "run" / "result.ply").exists()


def test_failure_is_recorded_with_its_reason(tmp_path):
    (tmp_path / "torn.obj").write_text("v 0 0 0\nf 1 2 3\n")
    arguments = ["source.path=torn.obj", "style=bubble", *SMOKE, "hydra.run.dir=run"]
    done = command(*arguments, cwd=tmp_path)
    assert "torn.obj" in complaint(done)
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert status["status"] == "failed"
    assert "torn.obj" in status["reason"]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("words.obj", "not a mesh at all", "it has no faces"),
        ("words.glb", "not a mesh at all", "is not a GLB file"),
        ("empty.stl", "", "is empty"),
        ("words.png", "not a picture", "is a text file"),
    ],
)
def test_a_file_that_is_none_is_refused_before_anything_heavy_loads(
    name, content, expected, tmp_path
):
    (tmp_path / name).write_text(content)
    given = ["critter", name] if name.endswith("png") else [name, "bubble"]
    code = (
        "import sys\nfrom styleexp.cli.main import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'trimesh', 'scipy') if m in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *given],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert expected in done.stderr
    assert done.stdout == "[]\n"
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("in the way")
    done = command("source=torus", "style=bubble", *SMOKE, "hydra.run.dir=file/run", cwd=tmp_path)
    assert "hydra.run.dir" in complaint(done)


def test_full_disk(tmp_path):
    """The results can't be written: one sentence, and no half of a file left."""
    import resource

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    done = fresh_command(
        "source=torus", "style=bubble", *SMOKE, "hydra.run.dir=run", cwd=tmp_path, preexec_fn=limit
    )
    assert "hydra.run.dir" in complaint(done)
    left = {p.name for p in (tmp_path / "run").iterdir()}
    assert not left & {"result.ply", "result.obj", "result.glb"}
    assert not [n for n in left if "partial" in n]


def test_debug_shows_the_traceback(tmp_path):
    done = command("source.path=no.obj", "style=bubble", "debug=true", cwd=tmp_path)
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_works_from_an_empty_folder_with_relative_paths_and_odd_names(tmp_path):
    from styleexp.inputs import meshes, shapes

    torus = shapes.make("torus", detail=800)
    meshes.save_mesh(torus, torus.vertices, tmp_path / "mein Käse=ring.ply")
    source = "source.path='mein Käse=ring.ply'"
    done = command(source, "style=bubble", *SMOKE, "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = styleexp.load_mesh(tmp_path / "run" / "result.glb")
    assert np.array_equal(result.faces, torus.faces)


def test_help_lists_the_choices_and_loads_nothing_heavy(tmp_path):
    code = (
        "import sys; sys.argv = ['styleexp', '--help-all']\n"
        "from styleexp.cli.main import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'mitsuba', 'moderngl', 'pyrender', 'trimesh', 'scipy', 'onnx'}\n"
        "print('HEAVY', sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "HEAVY []" in done.stdout
    for choice in ("soft_raster", "vgg16", "critter", "bubble", "optim", "hydra.run.dir"):
        assert choice in done.stdout


def test_import_loads_nothing_heavy():
    code = "import sys, styleexp; print(sorted({'torch', 'numpy', 'hydra'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("told", [{}, {"OMP_WAIT_POLICY": "ACTIVE", "GOMP_SPINCOUNT": "7"}])
def test_threads_are_told_how_to_wait_before_torch_loads(told):
    code = (
        "import os, sys, styleexp.cli\n"
        "print(os.environ['OMP_WAIT_POLICY'], os.environ['GOMP_SPINCOUNT'], 'torch' in sys.modules)"
    )
    names = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    env = {key: value for key, value in os.environ.items() if key not in names} | told
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [*(told.values() or ("PASSIVE", "3000")), "False"]


def test_shell_completion_knows_the_choices(tmp_path):
    done = command(
        "-sc", "query=bash", cwd=tmp_path, env={**os.environ, "COMP_LINE": "styleexp style=bub"}
    )
    assert "style=bubble" in done.stdout


def test_overrides_may_stand_on_both_sides_of_the_multirun_flag(tmp_path):
    done = command(
        "+experiment=sigma_ablation", "-m", "profile=smoke", "encoder=vgg19_random",
        "field.sigma=2", "preview.resolution=48", "hydra.sweep.dir=all", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "all" / "0" / "status.json").read_text())["status"] == "done"


def test_several_values_are_a_sweep_and_a_failed_job_does_not_stop_the_rest(tmp_path):
    done = command(
        "-m", "source=torus", "style.path=none.obj,there.ply", *SMOKE, "hydra.sweep.dir=all",
        cwd=with_style(tmp_path),
    )  # fmt: skip
    assert done.returncode == 2
    assert "none.obj" in done.stderr
    states = [json.loads((tmp_path / f"all/{n}/status.json").read_text()) for n in (0, 1)]
    assert [s["status"] for s in states] == ["failed", "done"]
    assert done.stdout.rstrip().endswith("all/report.html")
    assert "style.path none.obj, there.ply</title>" in (tmp_path / "all/report.html").read_text()


def with_style(folder):
    from styleexp.inputs import meshes, shapes

    style = shapes.make("stripe", detail=2000)
    meshes.save_mesh(style, style.vertices, folder / "there.ply")
    return folder


def test_texture_coordinates_and_faces_of_a_real_mesh_survive(named_mesh, tmp_path):
    """spot with a seam around it: its GLB keeps every corner's UV, its faces stay as they were."""
    import trimesh

    corners, uvs, faces = with_seam(styleexp.load_mesh(named_mesh("spot")), tmp_path / "spot.obj")
    done = command(
        "source.path=spot.obj", "style=bubble", *SMOKE, "hydra.run.dir=run", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    exported = trimesh.load(tmp_path / "run" / "result.glb", process=False).to_mesh()
    assert exported.faces.shape == faces.shape
    np.testing.assert_allclose(exported.visual.uv[exported.faces], uvs[corners], atol=1e-5)
    result = styleexp.load_mesh(tmp_path / "run" / "result.glb")
    assert np.array_equal(result.faces, styleexp.load_mesh(tmp_path / "spot.obj").faces)


def with_seam(mesh, path):
    """Write a mesh as OBJ with cylindrical texture coordinates that jump at a seam."""
    angle = np.arctan2(mesh.vertices[:, 0], mesh.vertices[:, 2]) / (2 * np.pi) + 0.5
    height = mesh.vertices[:, 1]
    height = (height - height.min()) / np.ptp(height)
    uvs = np.concatenate([np.stack([angle, height], 1), np.stack([angle + 1, height], 1)])
    spread = np.ptp(angle[mesh.faces], axis=1) > 0.5
    corners = mesh.faces + len(angle) * (spread[:, None] & (angle[mesh.faces] < 0.5))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in uvs.tolist()]
    pairs = np.stack([mesh.faces, corners], axis=2) + 1
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in face) for face in pairs.tolist()]
    path.write_text("\n".join(lines) + "\n")
    return corners, uvs, mesh.faces


def test_a_closed_pipe_is_an_interruption_that_can_be_resumed(tmp_path):
    arguments = ["source=torus", "style=bubble", *SMOKE, "optim.steps=20", "hydra.run.dir=run"]
    process = warm.start(
        "-m",
        "styleexp",
        *arguments,
        cwd=tmp_path,
        env=warm.coarse(),
        stdout=warm.PIPE,
        stderr=warm.PIPE,
    )
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=120) == 1
    assert "Traceback" not in process.stderr.read()
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert status["status"] == "interrupted"
    assert command("resume=run", cwd=tmp_path).returncode == 0


# ------------------------------------------------------------------------- words and leftovers


def test_bare_it_explains_itself_and_leaves_nothing(tmp_path):
    done = command(cwd=tmp_path)
    assert done.returncode == 2
    assert "usage: styleexp SOURCE STYLE" in done.stderr
    assert not any(tmp_path.iterdir())


def test_version_is_ours(tmp_path):
    assert command("--version", cwd=tmp_path).stdout == f"styleexp {styleexp.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere.obj", "bubble"], "the source 'nowhere.obj' does not exist"),
        (["critter", "style.path=nowhere.png"], "the style 'nowhere.png' does not exist"),
        (["scene.fbx", "bubble"], "'.fbx', which is not supported: export it as GLB"),
        (["part.step", "bubble"], "'.step', which is not supported: export it as STL"),
        (["critter", "bubble", "optim.steps=-3"], "optim.steps=-3 is not allowed"),
    ],
)
def test_a_refusal_loads_no_torch_and_leaves_no_folder(arguments, told, tmp_path):
    (tmp_path / "scene.fbx").touch()
    (tmp_path / "part.step").touch()
    code = (
        "import sys\n"
        "from styleexp.cli.main import main\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n"
        "    print(end.code, [m for m in ('torch', 'trimesh', 'scipy') if m in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told in done.stderr
    assert done.stdout == "2 []\n"
    assert {path.name for path in tmp_path.iterdir()} == {"scene.fbx", "part.step"}


@pytest.mark.parametrize(
    "words",
    ["styleexp --help", "styleexp --help-all", "styleexp.cli.assets list", "styleexp.cli.plugins"],
)
def test_what_is_printed_may_be_cut_off(words, tmp_path):
    done = subprocess.run(
        f"{sys.executable} -m {words} | head -2",
        shell=True, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    assert done.stdout.count("\n") == 2


def test_an_ascii_terminal_gets_its_sentence(tmp_path):
    done = fresh_command(
        "李.obj", "bubble", cwd=tmp_path, env={**os.environ, "PYTHONIOENCODING": "ascii"}
    )
    assert "\\u674e.obj" in complaint(done)


def test_a_working_folder_that_is_gone(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    done = subprocess.run(
        ["sh", "-c", f"rmdir '{gone}' && exec {sys.executable} -m styleexp critter bubble"],
        cwd=gone, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "no longer exists" in complaint(done)


def test_long_stages_are_named_and_named_again(monkeypatch, capsys):
    from styleexp.system import progress

    monkeypatch.setattr(progress, "FIRST", 0.2)
    monkeypatch.setattr(progress, "AGAIN", 0.5)
    with progress.announced():
        progress.doing("reading")
        time.sleep(2)
        progress.doing("")
        time.sleep(1)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "reading ..."
    assert lines[1].startswith("reading: ")
    progress.doing("drawing", at_once=True)  # nobody listens
    assert capsys.readouterr().out == ""
