"""Kept measurements: found again only where they would be the same."""

import numpy as np
import pytest

from styleexp.inputs import measured

GIVEN = {"vertices": np.arange(12.0).reshape(4, 3)}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path))
    return tmp_path / "measured"


class Making:
    """Makes an array, and counts how often."""

    def __init__(self, size=3):
        self.times, self.size = 0, size

    def __call__(self):
        self.times += 1
        return {"slopes": np.full((2, self.size), 0.1, order="F"), "flags": np.array([True, False])}


def test_the_second_time_it_is_read_with_the_same_bits():
    make = Making()
    first, second = (measured.kept("bank", GIVEN, "a", make) for _ in range(2))
    assert make.times == 1
    assert first.keys() == second.keys()
    for name, each in first.items():
        assert each.tobytes() == second[name].tobytes()
        assert (each.dtype, each.strides) == (second[name].dtype, second[name].strides)


def test_another_input_option_kind_or_number_of_threads_is_measured(monkeypatch):
    make = Making()
    measured.kept("bank", GIVEN, "a", make)
    moved = {"vertices": GIVEN["vertices"] + 1e-16 * np.eye(4, 3)}
    measured.kept("bank", moved, "a", make)
    measured.kept("bank", GIVEN, "b", make)
    measured.kept("looks", GIVEN, "a", make)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    measured.kept("bank", GIVEN, "a", make)
    assert make.times == 5
    with measured.anew():
        measured.kept("bank", GIVEN, "a", make)
    assert make.times == 6


@pytest.mark.parametrize("fault", ["cut", "changed", "empty", "another's"])
def test_a_damaged_file_is_measured_anew_and_replaced(cache, fault):
    make = Making()
    measured.kept("bank", GIVEN, "a", make)
    (path,) = cache.glob("bank-*")
    whole = path.read_bytes()
    measured.kept("bank", GIVEN, "b", make)
    (other,) = set(cache.glob("bank-*")) - {path}
    path.write_bytes(
        {"cut": whole[:-5], "changed": whole[:-5] + b"\0" * 5, "empty": b"",
         "another's": other.read_bytes()}[fault]
    )  # fmt: skip
    found = measured.kept("bank", GIVEN, "a", make)
    again = measured.kept("bank", GIVEN, "a", make)
    assert make.times == 3
    assert (found["slopes"] == 0.1).all()
    assert (again["slopes"] == 0.1).all()


def test_a_cache_that_cannot_be_written_is_done_without(cache):
    cache.parent.mkdir(exist_ok=True)
    cache.write_text("a file where the folder would be")
    make = Making()
    assert (measured.kept("bank", GIVEN, "a", make)["slopes"] == 0.1).all()
    assert (measured.kept("bank", GIVEN, "a", make)["slopes"] == 0.1).all()
    assert make.times == 2


def test_what_was_used_longest_ago_goes_first(cache, monkeypatch):
    monkeypatch.setattr(measured, "MOST_BYTES", 40_000)
    make = Making(size=1000)  # 16 kB each
    for about in ("a", "b"):
        measured.kept("bank", GIVEN, about, make)
    by_age = sorted(cache.glob("bank-*"), key=lambda path: path.stat().st_mtime_ns)
    measured.kept("bank", GIVEN, "a", make)  # used again
    measured.kept("bank", GIVEN, "c", make)
    assert make.times == 3
    assert len(list(cache.glob("bank-*"))) == 2
    assert by_age[0].exists()
    assert not by_age[1].exists()
