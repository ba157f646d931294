"""Whole programs kept on disk, ready to run: neither traced nor compiled again.

JAX keeps machine code by what was traced, and tracing the solver takes longer than
loading it. Here a program goes by what it follows from: the package's source, the
function, the kinds of its arguments, and how JAX is set up. It lies in a folder of
`jax_compilation_cache_dir`, which the command line sets; without that nothing is kept.
"""

import functools
import hashlib
import inspect
import logging
import os
import pickle
import platform
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.experimental import serialize_executable

log = logging.getLogger(__name__)

Options = Mapping[str, bool | int]
FOLDER = "programs"
_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_debug_nans",
    "jax_debug_infs",
)
_MARK = 32
"""Bytes before a program by which a damaged file is known."""


class _Array:
    """Where an array belongs."""


class _Program(NamedTuple):
    """What was compiled, from a list of arrays to one, and what these belong to."""

    run: Callable[..., list[jax.Array]]
    tree: Any
    static: Any

    def __call__(self, leaves: list[jax.Array]) -> Any:
        return eqx.combine(jax.tree.unflatten(self.tree, self.run(leaves)), self.static)


def _program(run: Callable[..., list[jax.Array]], form: Any) -> _Program:
    """`form` is what comes out, an `_Array` for every array in it."""
    places, static = eqx.partition(form, lambda x: isinstance(x, _Array))
    return _Program(run, jax.tree.structure(places), static)


def kept(
    function: Callable[..., Any], options: Callable[[], Options | None]
) -> Callable[..., Any]:
    """`eqx.filter_jit(function)`, its programs kept on disk where that can be done.

    It cannot where there is no folder for them, for arguments on other devices than the
    first, a function with variables of its surroundings, or an argument that does not
    pickle: they are then compiled as ever. `function` is known by where it is written:
    its decorators may check what it is given, and do no more.
    """
    plain = functools.cache(
        lambda: eqx.filter_jit(function, compiler_options=options())
    )
    ready: dict[str, _Program] = {}
    lock = threading.Lock()

    @functools.wraps(function)
    def call(*args, **kwargs):
        given = (args, kwargs)
        dynamic, static = eqx.partition(given, eqx.is_array)
        leaves, tree = jax.tree.flatten(dynamic)
        key = _key(function, options(), leaves, tree, static)
        if key is None:
            return plain()(*args, **kwargs)
        with lock:
            if key not in ready:
                file = Path(str(jax.config.jax_compilation_cache_dir))  # pyright: ignore
                file = file / FOLDER / key
                ready[key] = _load(file) or _compile(
                    function, options(), leaves, tree, static, file
                )
        return ready[key](leaves)

    return call


def _key(function, options, leaves, tree, static) -> str | None:
    """A hash of all that the program follows from; `None` if it cannot be kept."""
    if not jax.config.jax_compilation_cache_dir:  # pyright: ignore
        return None
    if jax.config.jax_disable_jit:  # pyright: ignore
        return None
    if any(x.devices() != {jax.devices()[0]} for x in leaves):
        return None
    written = inspect.unwrap(function)
    code = getattr(written, "__code__", None)
    if code is None or written.__closure__:
        return None
    if any(isinstance(x, np.ndarray) for x in jax.tree.leaves(static)):
        return None
    name = function.__module__, function.__qualname__, code.co_firstlineno
    kinds = [(x.shape, str(x.dtype), x.aval.weak_type) for x in leaves]
    chosen = sorted((options or {}).items())
    try:
        content = pickle.dumps((name, kinds, chosen, _setting(), tree, static))
    except Exception as error:  # whatever somebody's own argument raises
        log.debug("%s is not kept: %s", name, error)
        return None
    source = Path(inspect.getfile(written))
    return hashlib.sha256(_machine() + _source(source) + content).hexdigest()


def _setting() -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


@functools.cache
def _machine() -> bytes:
    """Versions, device, and what this processor can do."""
    device = jax.devices()[0]
    flags = platform.processor()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                flags = line
                break
    except OSError:
        pass
    parts = (
        *(jax.__version__, eqx.__version__, platform.python_version()),
        *(device.client.platform_version, device.device_kind, platform.machine()),
        *(os.environ.get("XLA_FLAGS", ""), flags),
    )
    return repr(parts).encode()


@functools.cache
def _source(file: Path) -> bytes:
    """A hash of this package, and of the function's own file if it is another's."""
    package = Path(__file__).parent
    files = sorted(package.rglob("*.py"))
    digest = hashlib.sha256()
    for path in files if file.is_relative_to(package) else [*files, file]:
        digest.update(str(path).encode() + path.read_bytes())
    return digest.digest()


def _compile(function, options, leaves, tree, static, file: Path) -> _Program:
    """Compiles, and keeps the program if that can be done."""
    forms = []

    def run(leaves):
        args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
        out = function(*args, **kwargs)
        place = lambda x: _Array() if eqx.is_array(x) else x
        forms.append(jax.tree.map(place, out))
        return jax.tree.leaves(eqx.filter(out, eqx.is_array))

    _listen()
    lowered = jax.jit(run, compiler_options=options).lower(leaves)
    # Tracing may run small programs of its own, which JAX has: only this one counts.
    _compiled.before = False
    compiled = lowered.compile()
    program = _program(compiled, forms[0])
    if _compiled.before:
        return program
    try:
        parts = serialize_executable.serialize(compiled)
        # The form itself: equinox' part of a tree's structure is not what it was when
        # it comes back.
        content = pickle.dumps((parts, forms[0]))
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f"{file.name}.{os.getpid()}.part")
        part.write_bytes(hashlib.sha256(content).digest() + content)
        part.replace(file)
    except Exception as error:  # what cannot be kept can be run all the same
        log.debug("%s is not kept: %s", function.__qualname__, error)
    return program


_compiled = threading.local()
"""`before`: whether JAX had machine code of its own. Once loaded it cannot be written
again: what is written then lacks functions."""


def _note(event: str, **_: Any) -> None:
    if event.endswith("/cache_hits"):
        _compiled.before = True


@functools.cache
def _listen() -> None:
    jax.monitoring.register_event_listener(_note)


@functools.cache
def _prepare_lapack() -> None:
    """Has JAX find LAPACK, as it does when it lowers what calls it: a program that
    comes from disk would call nothing, and end this one."""
    matrix = jax.ShapeDtypeStruct((2, 2), np.float32)
    jax.jit(jax.lax.linalg.cholesky).lower(matrix)


def _load(file: Path) -> _Program | None:
    """A program from its file; `None` if there is none, or it is damaged."""
    try:
        data = file.read_bytes()
        mark, content = data[:_MARK], data[_MARK:]
        if hashlib.sha256(content).digest() != mark:
            return None
        parts, form = pickle.loads(content)
        _prepare_lapack()
        first = jax.devices()[:1]
        run = serialize_executable.deserialize_and_load(*parts, execution_devices=first)
        return _program(run, form)
    except OSError:
        return None
    except Exception as error:  # of another version of something
        log.debug("%s: %s", file, error)
        return None
