"""A plan on a real Ray cluster, started on this machine. Needs an environment of its own."""

import json

import pytest

from tests.experiments.test_sweeps import JOBS, results, sweep, undisturbed, write_plan  # noqa: F401

pytest.importorskip(
    "hydra_plugins.hydra_ray_launcher", reason="needs the extra ray, which `make ray-test` installs"
)


def test_ray_runs_a_plan(undisturbed, tmp_path):  # noqa: F811
    arguments = ("--launcher", "ray", "--jobs", "2", "--folder", "out")
    done = sweep(write_plan(tmp_path), *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "out") == results(undisturbed[0])
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())["jobs"]
    assert len({job["process"] for job in manifest.values()}) > 1, "one process did everything"
    assert [job["attempts"] for job in manifest.values()] == [1] * JOBS
