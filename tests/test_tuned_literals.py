"""The counter of numbers that somebody chose (`tools/tuned_literals.py`)."""

import importlib.util
import sys
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[1] / "tools" / "tuned_literals.py"
if not _FILE.exists():
    pytest.skip("tools are not in a wheel", allow_module_level=True)
_SPEC = importlib.util.spec_from_file_location("tuned_literals", _FILE)
assert _SPEC is not None and _SPEC.loader is not None
counter = importlib.util.module_from_spec(_SPEC)
sys.modules["tuned_literals"] = counter
_SPEC.loader.exec_module(counter)


def found(text):
    return [(x.name, x.value, x.has_source) for x in counter.literals(text)]


def test_what_somebody_chose_counts_with_its_source():
    text = """
_LIMIT = 0.35
\"\"\"From the data.\"\"\"
_OTHER = 0.7

LIMITS = (
    Limit(0.3, source="people differ by 0.2"),
    Limit(0.4),
)

def shrink(x, share=0.9):
    # Twice the noise of tracks.
    return x * 1.4 if x > 17 else share

# Measured on walks.
_TABLE = {
    "walk": 0.3,
    "run": 0.7,
}
"""
    assert found(text) == [
        ("_LIMIT", 0.35, True),
        ("_OTHER", 0.7, False),
        ("LIMITS", 0.3, True),
        ("LIMITS", 0.4, False),
        ("shrink", 0.9, False),
        ("shrink", 1.4, True),
        ("shrink", 17, True),
        ("_TABLE", 0.3, True),
        ("_TABLE", 0.7, True),
    ]


@pytest.mark.parametrize(
    "text",
    [
        "x[5:7] + y[-11]",
        "x.reshape(17, -1) + np.zeros((5, 7))",
        "x ** 5 + 1e-9 * 100.0",
        "np.degrees(x) * 180 / np.pi",
        "f'{x:7.3f}'",
        "JOINTS = (5, 7, 11, 13)",
        "def f(x: Float[Array, '5 7']) -> None: ...",
        "np.mean(x, axis=5)",
        "axis.plot(x, lw=1.3, alpha=0.7)",
        "x = -0.5 * y + 2 * z - 1",
    ],
)
def test_structure_and_units_do_not(text):
    assert found(text) == []
