"""Reads and validates `summary.json` of a run folder, which is untrusted input."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import files

_MAX_LETTERS = 10_000
_MAX_NUMBER = 1e15
"""Above everything that is counted or measured; products of two are finite."""
_REASON_SCHEMA = {"message": str, "advice": str, "status": str}
_SCHEMA: dict[str, Any] = {
    "status": str,
    "reasons": [(str, _REASON_SCHEMA)],
    "headline": [str],
    "warnings": [str],
    "input": (
        str,
        {"name": str, "frames": int, "width": int, "height": int, "fps": float},
    ),
    "settings": {},
    "camera_motion": str,
    "camera_path_m": float,
    "scale": {"value": float, "sigma": float},
    "people": [
        {
            "status": str,
            "reasons": [(str, _REASON_SCHEMA)],
            "stature_m": float,
            "stature_sigma_m": float,
            "speed_m_s": float,
        }
    ],
    "frames_used": [int],
    "durations_s": {"*": float},
    "errors": {"*": {"*": (float, str, bool, {}, [])}},
    "has_camera": bool,
}
"""Types of the entries that readers of run folders use. Any may be missing or null; `*`
is any name, and a tuple lists alternatives."""


def read_summary(file: Path) -> dict[str, Any]:
    """Reads a `summary.json` and checks the types of the entries that readers use.

    **Raises:** `InputError`, one line that names the file, the place, what was found
    and what was expected.
    """
    found = files.read_json(file, "the summary of a run")
    if not isinstance(found, dict):
        raise InputError(f"{file}: {type(found).__name__}, expected an object.")
    for name, form in _SCHEMA.items():
        if wrong := _misfit(name, found.get(name), form):
            raise InputError(f"{file}: {wrong}.")
    return found


def _misfit(place: str, value: Any, form: Any) -> str:
    """Returns the error message for a value that does not fit the schema, or "" if it
    does."""
    if value is None:
        return ""
    if isinstance(form, tuple):
        wrong = [_misfit(place, value, one) for one in form]
        return "" if "" in wrong else wrong[-1]
    if isinstance(form, Mapping):
        if not isinstance(value, dict):
            return _wrong(place, value, "an object")
        named = dict(form)
        if "*" in named:
            named = dict.fromkeys(value, named["*"])
        parts = ((f"{place}.{n}", value.get(n), one) for n, one in named.items())
        return next(filter(None, (_misfit(*part) for part in parts)), "")
    if isinstance(form, Sequence):
        if not isinstance(value, list):
            return _wrong(place, value, "a list")
        if form and None in value:
            return _wrong(f"{place}[{value.index(None)}]", None, "no null")
        parts = (
            (f"{place}[{k}]", item, form[0]) for k, item in enumerate(value) if form
        )
        return next(filter(None, (_misfit(*part) for part in parts)), "")
    if form is str:
        fits = isinstance(value, str) and len(value) <= _MAX_LETTERS
        return (
            ""
            if fits
            else _wrong(place, value, f"text of at most {_MAX_LETTERS} letters")
        )
    if form is bool:
        return "" if isinstance(value, bool) else _wrong(place, value, "true or false")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not abs(value) < _MAX_NUMBER or not math.isfinite(value):
        return _wrong(place, value, "a number")
    if form is int and value != int(value):
        return _wrong(place, value, "a whole number")
    return ""


def _wrong(place: str, value: Any, expected: str) -> str:
    """Returns the error message for a value, which may be of any size."""
    kinds = {dict: "an object", list: "a list", bool: "true or false"}
    found = kinds.get(type(value))
    if found is None:
        large = isinstance(value, int) and abs(value) >= _MAX_NUMBER
        found = "a number of many digits" if large else repr(value)[:80]
    return f"{place[:80]} is {found}, expected {expected}"
