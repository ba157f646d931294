"""Comparing the figures of two revisions, sequence by sequence."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[1] / "benchmarks" / "figures_by_sequence.py"


@pytest.fixture(scope="module")
def figures():
    if not FILE.exists():
        pytest.skip("the benchmarks are not part of an installed package")
    spec = importlib.util.spec_from_file_location("figures_by_sequence", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(errors, part="tripods"):
    return [
        {
            "part": part,
            "input": "keypoints",
            "sequence": f"E{i}",
            "up": e,
            "status": "ok",
        }
        for i, e in enumerate(errors)
    ]


def test_a_file_is_no_worse_than_itself(figures):
    same = rows([1.0, 2.0, 3.0])
    lines, worse = figures.compare(same, same)
    assert not worse and any("no worse" in line for line in lines)


def test_a_mean_that_rises_by_more_than_its_error_is_worse(figures):
    before, after = rows([1.0, 2.0, 3.0]), rows([1.15, 2.16, 3.14])
    assert figures.compare(before, after)[1]
    assert not figures.compare(after, before)[1]


def test_differences_that_scatter_about_zero_are_no_worse(figures):
    before, after = rows([3.0, 3.0, 3.0, 3.0]), rows([3.3, 2.7, 3.2, 2.85])
    assert not figures.compare(before, after)[1]


def test_one_sequence_that_is_worse_by_a_quarter_is_worse(figures):
    before, after = rows([1.0, 2.0, 3.0]), rows([0.5, 1.0, 3.9])
    lines, worse = figures.compare(before, after)
    assert worse and any("E2" in line for line in lines)
    # A quarter of next to nothing is rounding.
    assert not figures.compare(rows([0.1, 2.0, 3.0]), rows([0.2, 1.0, 3.0]))[1]


def test_rows_without_a_partner_are_counted_not_compared(figures):
    lines, worse = figures.compare(rows([1.0, 2.0]), rows([1.0]))
    assert not worse and "1 pairs; 1 rows" in lines[-1]
