"""The one place where input files are opened.

A file is opened only if it is a plain file within the budget, and whatever its content
does to a parser ends in one `InputError` with the file, the place, what was found and
what was expected. Arrays are read by `archive`, images by `images`, videos by `video`;
pickles, which can hold more than data, by `safe_pickle`.
"""

import contextlib
import csv
import io
import json
import os
import re
import stat
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget
from bodyslam_jax.io.declared import Fields, fields

_MAX_DIGITS = 19
"""Largest number of digits of a whole number that is kept as such; a longer one becomes
a float."""


@contextlib.contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Attributes every error of a library in the block to the file that it reads.

    **Raises:** `InputError`, one line: the file, what was found, and `expected`.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        # Parsers fail in any way on damaged files: with errors of their own, of memory,
        # of recursion, of the compression.
        words = " ".join(str(error).split())[:120]
        found = f"{type(error).__name__}: {words}" if words else type(error).__name__
        raise InputError(f"{path}: not {expected}, or damaged ({found}).") from None


def open_binary(path: Path, what: str = "") -> io.BufferedReader:
    """Returns the opened file, after checking that it is a plain file within the
    budget.

    **Raises:** `InputError`, naming the file, if it is missing, cannot be read, is a
    folder, a pipe or a device, or exceeds the budget.
    """
    expected = what or "a file"
    try:
        state = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected {expected}.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: {reason}, expected {expected}.") from None
    if not stat.S_ISREG(state.st_mode):
        found = "a folder" if stat.S_ISDIR(state.st_mode) else "a pipe or a device"
        raise InputError(f"{path}: {found}, expected {expected}.")
    budget.check_bytes(path, state.st_size)
    try:
        return open(path, "rb")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}, expected {expected}.") from None


def is_zip(path: Path) -> bool:
    """Returns True if a file begins as zip archives do.

    **Raises:** `InputError` as `open_binary`.
    """
    with open_binary(path) as file, reading(path, "a readable file"):
        return file.read(4) == b"PK\x03\x04"


def read_bytes(path: Path, what: str = "") -> bytes:
    """Returns the whole content of a file.

    Args:
        what: was expected, for messages.

    **Raises:** `InputError` as `open_binary`.
    """
    most = budget.current().bytes
    with open_binary(path, what) as file, reading(path, what or "a readable file"):
        content = file.read(most + 1)
    budget.check_bytes(path, len(content))  # it may have grown, or have no size
    return content


def read_text(path: Path, what: str = "a text file") -> str:
    """Returns the text of a file in UTF-8, or in UTF-16 if it says so; a mark of the
    order of bytes, which some editors write, is left out.

    **Raises:** `InputError` as `open_binary`, or if it is binary.
    """
    content = read_bytes(path, what)
    is_wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = content.decode("utf-16" if is_wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is no text (UTF-8), expected {what}."
        ) from None
    if "\0" in text:
        raise InputError(
            f"{path}: character {text.index(chr(0))} is a zero, expected {what}."
        )
    return text


def read_lines(path: Path, what: str = "a text file") -> list[str]:
    """Returns the lines of a text file, without their ends.

    **Raises:** as `read_text`.
    """
    return re.split(r"\r\n|\r|\n", read_text(path, what))


def read_csv(path: Path, what: str = "a table (CSV)") -> list[list[str]]:
    """Returns the rows of a CSV file that have cells.

    **Raises:** as `read_text`, or if its quotes are wrong.
    """
    rows, reader = [], None
    try:
        reader = csv.reader(io.StringIO(read_text(path, what), newline=""), strict=True)
        rows = [row for row in reader if row]
    except csv.Error as error:
        line = reader.line_num if reader else 1
        raise InputError(f"{path}, line {line}: {error}; expected {what}.") from None
    return rows


def read_json(path: Path, what: str = "a JSON file") -> Any:
    """Returns the content of a JSON file. Whole numbers beyond 64 bits become floats.

    **Raises:** as `read_text`, or if it is not JSON, is nested too deeply, has too many
    values, or a name twice in one object.
    """
    return parse_json(read_text(path, what), path, what)


def parse_json(text: str, path: Path, what: str = "a JSON file") -> Any:
    """Returns the content of a JSON text that is within the file at `path`, as
    `read_json`."""
    number = 1 + text.count(",") + text.count("[") + text.count("{")
    if number > budget.MAX_ELEMENTS:
        raise InputError(
            f"{path}: {number} values, expected at most {budget.MAX_ELEMENTS} of JSON "
            "(.npz has no such limit)."
        )
    if not text.strip():
        raise InputError(f"{path}: empty, expected {what}.")
    try:
        found = json.loads(text, parse_int=_whole, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}, line {error.lineno}: not JSON ({error.msg}), expected {what}."
        ) from None
    except _Repeated as error:
        raise InputError(
            f"{path}: the name {error.args[0]!r} twice in one object, expected {what}."
        ) from None
    except RecursionError:
        raise InputError(_too_deep(path, what)) from None
    except (ValueError, MemoryError, OverflowError) as error:
        raise InputError(f"{path}: not JSON ({error}), expected {what}.") from None
    if _depth(found) > budget.MAX_DEPTH:
        raise InputError(_too_deep(path, what))
    return found


def read_json_fields(path: Path, what: str = "a JSON file") -> Fields:
    """Returns the entries of a JSON object, which are checked as they are read.

    **Raises:** as `read_json`, or if it is no object.
    """
    return fields(path, read_json(path, what))


def read_yaml(path: Path, what: str = "a YAML file") -> Any:
    """Returns the content of a YAML file; a date stays the text that it is.

    OpenCV's files are read, too: `%YAML:1.0`, and `!!opencv-matrix` as a dictionary.

    **Raises:** as `read_text`, or if it is not YAML, refers to itself (`&name`,
    `*name`), is too large or nested too deeply, or has a name twice in one mapping.
    """
    import yaml

    text = read_text(path, what)
    if len(text) > budget.MAX_YAML_BYTES:
        raise InputError(
            f"{path}: {len(text)} characters, expected at most "
            f"{budget.MAX_YAML_BYTES} of YAML."
        )
    text = re.sub(r"\A%YAML:[^\n]*", "", text)
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                mark = event.start_mark
                raise InputError(
                    f"{path}, line {mark.line + 1}: a reference (& or *), expected "
                    "each value written out."
                )
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > budget.MAX_DEPTH:
                raise InputError(_too_deep(path, what))
        return yaml.load(text, Loader=_plain_yaml())
    except InputError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        problem = " ".join(str(error.problem or error.context).split())[:120]
        raise InputError(
            f"{path}{line}: not YAML ({problem}), expected {what}."
        ) from None
    except Exception as error:
        problem = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not YAML ({problem}), expected {what}.") from None


def read_toml(path: Path, what: str = "a TOML file") -> dict[str, Any]:
    """Returns the content of a TOML file.

    **Raises:** as `read_text`, or if it is not TOML or too large.
    """
    text = _short_text(path, what)
    with reading(path, what):
        return tomllib.loads(text)


def read_xml(path: Path, what: str = "an XML file") -> ElementTree.Element:
    """Returns the root of an XML file that declares no entities, which could expand.

    **Raises:** as `read_text`, or if it is not XML, declares a document type or
    entities, or is too large.
    """
    text = _short_text(path, what)
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(f"{path}: declares entities (DOCTYPE), expected plain XML.")
    with reading(path, what):
        # The text is decoded already, whatever encoding it declares.
        return ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))


def _short_text(path: Path, what: str) -> str:
    text = read_text(path, what)
    if len(text) > budget.MAX_MARKUP_BYTES:
        raise InputError(
            f"{path}: {len(text)} characters, expected at most "
            f"{budget.MAX_MARKUP_BYTES} of {what}."
        )
    return text


class Members:
    """The files within a zip archive, unpacked one at a time within the budget."""

    def __init__(self, path: Path, what: str = "a zip archive") -> None:
        self.path, self.what = path, what
        self._info: dict[str, zipfile.ZipInfo] = {}
        with self._opened() as archive:
            entries = archive.infolist()
        if len(entries) > budget.MAX_MEMBERS:
            raise InputError(
                f"{path}: {len(entries)} files in it, expected {what} with at most "
                f"{budget.MAX_MEMBERS}."
            )
        for entry in entries:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(
                    f"{path}: {entry.filename[:60]!r} is compressed by method "
                    f"{entry.compress_type}, expected none or deflate."
                )
            if entry.filename in self._info:
                raise InputError(
                    f"{path}: {entry.filename[:60]!r} twice, expected {what}."
                )
            self._info[entry.filename] = entry
        total = sum(entry.file_size for entry in entries)
        budget.check_bytes(path, total, "unpacks to ")

    @property
    def names(self) -> list[str]:
        return list(self._info)

    def read(self, name: str) -> bytes:
        """Returns one file.

        **Raises:** `InputError`, naming both, if it is not there or damaged.
        """
        with self.opened(name) as file:
            return file.read(self._info[name].file_size + 1)

    @contextlib.contextmanager
    def opened(self, name: str) -> Iterator[Any]:
        """Returns one file, as a stream of what it unpacks to."""
        if name not in self._info:
            found = ", ".join(other[:40] for other in self.names[:12]) or "nothing"
            raise InputError(f"{self.path}: no {name} in it; found {found}.")
        with self._opened() as archive:
            with reading(self.path, f"{self.what} with a whole {name}"):
                with archive.open(self._info[name]) as file:
                    yield file

    def size(self, name: str) -> int:
        """Returns the bytes that a file unpacks to, as the archive declares it."""
        return self._info[name].file_size

    @contextlib.contextmanager
    def _opened(self) -> Iterator[zipfile.ZipFile]:
        with open_binary(self.path, self.what) as file:
            with reading(self.path, self.what):
                with zipfile.ZipFile(file) as archive:
                    yield archive


def read_zip(path: Path, what: str = "a zip archive") -> Members:
    """Returns the files within a zip archive.

    **Raises:** `InputError` as `open_binary`, or if it is no zip archive, is damaged,
    or unpacks to more than the budget.
    """
    return Members(path, what)


class _Repeated(Exception):
    """A name occurs twice in one object."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise _Repeated(_repeated([name for name, _ in pairs]))
    return found


def _repeated(names: list[str]) -> str:
    """Returns the first name that occurs twice."""
    seen: set[str] = set()
    return next(n for n in names if n in seen or seen.add(n))[:60]


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= _MAX_DIGITS else float(digits)


def _depth(data: Any) -> int:
    """Returns the levels of nesting, counted up to one more than are allowed."""
    level, depth = [data], 0
    while level and depth <= budget.MAX_DEPTH:
        level = [one for one in level if type(one) in (list, dict)]
        depth += bool(level)
        level = [x for c in level for x in (c.values() if type(c) is dict else c)]
    return depth


def _too_deep(path: Path, what: str) -> str:
    return f"{path}: nested more than {budget.MAX_DEPTH} deep, expected {what}."


def _mapping(loader: Any, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


def _plain_yaml() -> Any:
    """Returns a loader of text, numbers, lists and mappings."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            names = [key.value for key, _ in node.value if isinstance(key.value, str)]
            if len(set(names)) < len(names):
                raise yaml.MarkedYAMLError(
                    problem=f"the name {_repeated(names)!r} twice",
                    problem_mark=node.start_mark,
                )
            return super().construct_mapping(node, deep)

    stamp = "tag:yaml.org,2002:timestamp"
    Loader.yaml_implicit_resolvers = {
        first: [(tag, rule) for tag, rule in rules if tag != stamp]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    Loader.add_constructor(
        "tag:yaml.org,2002:opencv-matrix",
        _mapping,
    )
    return Loader
