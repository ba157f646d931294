"""The registry of readers: what a format of one tool is, and how the format of a given
file is found.

A format is one class in one file: `recognises` tells its files from others, `read`
reads them, `layout` names what they hold. Keypoint formats
(`io/keypoints/keypoint_format.py`) are in the modules of `io/keypoints/formats/`, body
formats (`io/bodies/body_format.py`) in those of `io/bodies/formats/`: every class of
those folders is used, without a list of them. Other packages add theirs by an entry
point (`CONTRIBUTING.md`).
"""

import abc
import contextlib
import dataclasses
import importlib
import importlib.metadata
import inspect
import logging
import pkgutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import InvalidContent

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Source:
    """A file or folder for which a reader is sought."""

    path: Path
    content: Any = None
    """The parsed content; `None` for a folder, and for a file whose suffix only some
    formats know (`Format.suffixes`): those open it themselves, by `io.files`."""


class Format(abc.ABC):
    """A tool's files: how they are recognised and what is in them."""

    name: ClassVar[str]
    """Name in messages."""
    layout: ClassVar[tuple[str, ...] | None] = None
    """Names of the contents of the files; subclasses define of which."""
    folder: ClassVar[str] = ""
    """Pattern of the names of the files, if the format is a folder of them."""
    suffixes: ClassVar[tuple[str, ...]] = ()
    """Suffixes (lower case, with the dot) of files that only this format can open."""

    @abc.abstractmethod
    def recognises(self, source: Source) -> bool:
        """Returns True if the file or folder is of this format; decided by its
        content."""


F = TypeVar("F", bound=Format)


def formats(kind: type[F], package: str, group: str) -> list[F]:
    """Returns all formats of a kind: those in the modules of `package`, in the order of
    the modules' names, then those that installed packages name as entry points of
    `group`.

    An entry point that cannot be loaded, or is no such format, is left out with a
    warning: it must not keep others from being read.
    """
    found: list[F] = []
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        content = vars(importlib.import_module(f"{package}.{module.name}"))
        found += [
            one()
            for one in content.values()
            if isinstance(one, type)
            and issubclass(one, kind)
            and one.__module__ == content["__name__"]
            and not inspect.isabstract(one)
        ]
    for entry in importlib.metadata.entry_points(group=group):
        try:
            one = entry.load()()
        except Exception as error:  # of another package: whatever its import raises
            words = " ".join(f"{type(error).__name__}: {error}".split())[:120]
            _log.warning("format %s (%s) left out: %s", entry.name, entry.value, words)
            continue
        if isinstance(one, kind):
            found.append(one)
        else:
            what = f"{type(one).__name__}, expected a {kind.__name__}"
            _log.warning("format %s (%s) left out: %s", entry.name, entry.value, what)
    return found


def format_of(
    path: Path, among: Sequence[F], parse: Callable[[Path], Any]
) -> tuple[F | None, Source]:
    """Returns the first format that recognises the file or folder, or `None`; and the
    file with its content as `parse` gives it.

    **Raises:** `InputError` of `parse`, or if no format that is a folder recognises a
    folder.
    """
    if path.is_dir():
        source = Source(path)
        among = [f for f in among if f.folder]
        for one in among:
            if _recognised(one, source):
                return one, source
        expected = " or ".join(f"{f.folder} ({f.name})" for f in among)
        raise InputError(f"{path}: no {expected} in this folder.")
    own = [f for f in among if path.suffix.lower() in f.suffixes]
    source = Source(path) if own else Source(path, parse(path))
    for one in own or [f for f in among if not f.suffixes]:
        if _recognised(one, source):
            return one, source
    return None, source


def _recognised(one: Format, source: Source) -> bool:
    try:
        return one.recognises(source)
    except Exception:
        # A test of names and shapes that fails on what a file holds does not
        # recognise it; other formats are still asked.
        return False


def names_of(among: Sequence[Format]) -> str:
    """Returns the names of the formats, for messages: `A, B or C`."""
    *most, last = dict.fromkeys(f.name for f in among)
    return f"{', '.join(most)} or {last}" if most else last


@contextlib.contextmanager
def attributed(path: Path, what: str) -> Iterator[None]:
    """Attributes every error of a format's reader in the block to its file.

    **Raises:** `InputError`, one line that names the file.
    """
    try:
        yield
    except InputError:
        raise
    except InvalidContent as error:
        raise InputError(f"{path}: {error}.") from None
    except Exception as error:
        # Dictionaries of other tools, nested in any way: whatever fails is theirs.
        words = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: incomplete or damaged {what} ({words}).") from None
