"""Mutations of well-formed inputs: of values, of text, of archives, pickles and bytes.

Every mutation is a function of its input and of a `random.Random`, so that an input is
known by a seed, the name of its target and a number.
"""

import copy
import io
import json
import math
import pickle
import pickletools
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

NUMBERS = (0, -1, 1, 2, 255, 256, 65536, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63)
NUMBERS += (2**64, -(2**63), 10**18, 10**40, 0.5, -0.0, 1e-300, 1e-8, 1e12, 1e38, 1e39)
NUMBERS += (1e300, 1e308, -1e308, math.inf, -math.inf, math.nan)
"""Values at the ends of types and of what readers expect."""
WORDS = ("", " ", "nan", "inf", "-1", "1e999", "9" * 50, "9" * 5000, "\0", "\ufeff")
WORDS += ("../../x", "/etc/hostname", "x" * 300, "x" * 70_000, "𝟏", "\u2028", "{", "[")
WORDS += (
    "%s",
    "true",
    "null",
    "0x10",
    "1_000",
    "é",
    "-",
    "*",
    "&a",
    "~",
    "'",
    '"',
    "#",
)
TYPES = ("<f2", "<f4", ">f8", "<i1", "<u8", ">i4", "<c16", "?", "S8", "U3", "<M8[s]")
_MAX_BYTES = 4_000_000
"""Size of a mutated input; what is larger tells of nothing but its size."""


def mutated(form: str, tree: Any, rng: random.Random) -> bytes:
    """An input of a form (`DUMPS`) with one to three mutations."""
    roll = rng.random()
    if form in DUMPS and roll < 0.6:
        holder = [copy.deepcopy(tree)]
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            _mutate_value(holder, rng)
        try:
            content = DUMPS[form](holder[0], rng)
        except Exception:  # a value that the form cannot have
            content = DUMPS[form](tree, rng)
        if roll > 0.1:
            return content[:_MAX_BYTES]
    else:
        content = DUMPS[form](tree, rng) if form in DUMPS else bytes(tree)
    kinds = [_bytes]
    kinds += [_text] * 4 if form in ("json", "yaml", "text", "csv", "openpose") else []
    kinds += [_zip] * 3 if form in ("npz", "pt", "zip") else []
    kinds += [_opcodes] * 4 if form in ("pickle", "pt", "joblib") else []
    kinds += [_npy] * 2 if form == "npy" else []
    for _ in range(rng.choice((1, 1, 2))):
        content = rng.choice(kinds)(content, rng)
    return content[:_MAX_BYTES]


# Values


def _places(value: Any, found: list, parent: Any = None, key: Any = None) -> list:
    """All containers and keys at which a value is."""
    if parent is not None:
        found.append((parent, key))
    if isinstance(value, dict):
        for name in list(value)[:40]:
            _places(value[name], found, value, name)
    elif isinstance(value, list):
        for k in range(min(len(value), 12)):
            _places(value[k], found, value, k)
    return found


def _mutate_value(holder: list, rng: random.Random) -> None:
    parent, key = rng.choice(_places(holder[0], [], holder, 0))
    value, roll = parent[key], rng.random()
    if roll < 0.12 and parent is not holder:
        del parent[key]
    elif roll < 0.2:
        parent[key] = rng.choice([None, True, [], {}, "text", 3, 1.5, [[1]], {"a": 1}])
    elif roll < 0.25 and isinstance(parent, dict):
        parent[rng.choice(WORDS)] = copy.deepcopy(value)
    elif roll < 0.3 and isinstance(parent, list) and parent is not holder:
        parent[key:key] = [value] * rng.choice((1, 2, 300))
    elif roll < 0.36:
        others = _places(holder[0], [], holder, 0)
        other, name = rng.choice(others)
        parent[key] = copy.deepcopy(other[name])
    elif isinstance(value, np.ndarray):
        parent[key] = _array(value, rng)
    elif isinstance(value, bool):
        parent[key] = not value
    elif isinstance(value, (int, float)):
        parent[key] = rng.choice(NUMBERS)
    elif isinstance(value, str):
        at = rng.randrange(len(value) + 1)
        word = rng.choice(WORDS)
        parent[key] = rng.choice([word, value[:at] + word + value[at:], value[:at]])
    elif isinstance(value, (list, dict)) and value:
        inner = rng.choice(
            list(range(len(value)) if isinstance(value, list) else value)
        )
        value[inner] = rng.choice([*NUMBERS, None, "text", [], {}])
    else:
        parent[key] = rng.choice([*NUMBERS, *WORDS])


def _array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    array, roll = np.array(array), rng.random()
    if roll < 0.45 and array.size and array.dtype.kind in "fiu":
        flat = array.reshape(-1).copy()
        number = rng.choice(NUMBERS)
        at = rng.choice([rng.randrange(array.size), slice(None), slice(0, None, 7)])
        with np.errstate(all="ignore"):
            try:
                flat[at] = number
            except (OverflowError, ValueError):
                flat = flat.astype(np.float64)
                flat[at] = min(max(float(number), -1e308), 1e308)
        return flat.reshape(array.shape)
    if roll < 0.6:
        kind = np.dtype(rng.choice(TYPES))
        # Casts from and to text and dates have crashed NumPy itself, and this process.
        if kind.kind in "SUM" or array.dtype.kind not in "fiub":
            return np.zeros(array.shape, kind)
        with np.errstate(all="ignore"):
            return array.astype(kind)
    if roll < 0.95:
        cut = [slice(0, rng.choice((0, 1, n, max(n - 1, 0)))) for n in array.shape]
        return rng.choice(
            [
                array[..., None],
                array[None],
                array.reshape(-1),
                array.T,
                array[tuple(cut)],
                np.zeros((0, *array.shape[1:]), array.dtype),
                np.concatenate([array.reshape(-1)] * 2),
                np.repeat(np.atleast_1d(array), 3, axis=0),
                np.zeros(()),
                np.zeros((0, 10**9, 3)),
                np.array(["a", "b"]),
                np.atleast_1d(array)[::-1],
            ]
        )
    if array.dtype.kind not in "fiub":
        return np.zeros(array.shape)
    with np.errstate(all="ignore"):
        factor = rng.choice((1e3, 1e-9, 1e30, -1))
        return np.atleast_1d(array).astype(np.float64) * factor


# Forms


def _json(tree: Any, rng: random.Random) -> bytes:
    return json.dumps(tree, default=lambda x: x.tolist()).encode()


def _yaml(tree: Any, rng: random.Random) -> bytes:
    import yaml

    return yaml.safe_dump(tree, sort_keys=False).encode()


def _npz(tree: Any, rng: random.Random) -> bytes:
    stream = io.BytesIO()
    save: Any = rng.choice([np.savez, np.savez_compressed])
    with np.errstate(all="ignore"):
        save(stream, **{str(name)[:80]: np.asarray(x) for name, x in tree.items()})
    return stream.getvalue()


def _npy_of(tree: Any, rng: random.Random) -> bytes:
    stream = io.BytesIO()
    content = np.array(tree, dtype=object) if isinstance(tree, dict) else tree
    np.save(stream, content, allow_pickle=True)
    return stream.getvalue()


def _pickle(tree: Any, rng: random.Random) -> bytes:
    return pickle.dumps(tree, protocol=rng.choice((2, 3, 4, 5)))


def _joblib(tree: Any, rng: random.Random) -> bytes:
    return zlib.compress(_pickle(tree, rng))


def _csv(tree: Any, rng: random.Random) -> bytes:
    return "\n".join(",".join(map(str, row)) for row in tree).encode()


DUMPS: dict[str, Callable[[Any, random.Random], bytes]] = {
    "json": _json,
    "yaml": _yaml,
    "npz": _npz,
    "npy": _npy_of,
    "pickle": _pickle,
    "joblib": _joblib,
    "csv": _csv,
}
"""How values become a file; other forms (`text`, `pt`, `zip`, `bytes`) are bytes."""


# Text

_TOKEN = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\w+")


def _text(content: bytes, rng: random.Random) -> bytes:
    roll = rng.random()
    tokens = list(_TOKEN.finditer(content))
    if roll < 0.5 and tokens:
        found = rng.choice(tokens)
        new = rng.choice([*map(str, NUMBERS), *WORDS]).encode()
        return content[: found.start()] + new + content[found.end() :]
    if roll < 0.6 and tokens:
        found = rng.choice(tokens)
        depth = rng.choice((10, 100, 3000, 100_000))
        first, last = rng.choice(((b"[", b"]"), (b'{"a":', b"}"), (b"- ", b"")))
        deep = first * depth + rng.choice((b"1" + last * depth, b""))
        return content[: found.start()] + deep + content[found.end() :]
    lines = content.splitlines(keepends=True)
    if roll < 0.9 and lines:
        k = rng.randrange(len(lines))
        action = rng.randrange(5)
        if action == 0:
            del lines[k]
        elif action == 1:
            lines[k:k] = [lines[k]] * rng.choice((1, 2, 1000))
        elif action == 2:
            lines[k] = rng.choice(lines)
        elif action == 3:
            words = lines[k].split()
            rng.shuffle(words)
            lines[k] = b" ".join(words) + b"\n"
        else:
            lines[k] = lines[k][: rng.randrange(len(lines[k]) + 1)]
        return b"".join(lines)
    return rng.choice(
        [
            content.decode("utf-8", "replace").encode("utf-16"),
            b"\xef\xbb\xbf" + content,
            content.replace(b"\n", b"\r"),
            content.replace(b",", b";"),
            content.replace(b".", b","),
            content + b"\0" * 100,
            b"",
        ]
    )


# Archives


def _zip(content: bytes, rng: random.Random) -> bytes:
    """Members that are mutated with a right checksum, or lie about their size."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:
        return _bytes(content, rng)
    if not members:
        return _bytes(content, rng)
    name, roll = rng.choice(list(members)), rng.random()
    if roll < 0.2:
        return _lying(content, rng)
    entries = list(members.items())
    if roll < 0.65:
        change = _npy if members[name].startswith(b"\x93NUMPY") else _bytes
        if name.endswith(".pkl"):
            change = _opcodes
        entries = [(n, change(x, rng) if n == name else x) for n, x in entries]
    elif roll < 0.75:
        entries = [one for one in entries if one[0] != name]
    elif roll < 0.85:
        other = rng.choice([*members, "x.npy", "../x", "a/" * 50, "\u2028", name + "/"])
        entries = [(other if n == name else n, x) for n, x in entries]
    elif roll < 0.9:
        entries += [(name, members[name])]
    elif roll < 0.95:
        header = _npy_header("<f8", (rng.choice((40_000_000, 10**9, 2**62)),))
        entries = [(n, header + bytes(9) if n == name else x) for n, x in entries]
    else:
        entries = [(n, bytes(30_000_000) if n == name else x) for n, x in entries]
    stream = io.BytesIO()
    methods = [zipfile.ZIP_DEFLATED] * 3 + [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2]
    method = zipfile.ZIP_DEFLATED if roll >= 0.95 else rng.choice(methods)
    with zipfile.ZipFile(stream, "w", method) as archive:
        for other, data in entries:
            archive.writestr(other or "x", data)
    return stream.getvalue()


def _lying(content: bytes, rng: random.Random) -> bytes:
    """Sizes, offsets, methods and counts in the headers of a zip archive."""
    data = bytearray(content)
    marks = {b"PK\x03\x04": range(4, 30), b"PK\x01\x02": range(4, 46)}
    marks[b"PK\x05\x06"] = range(4, 22)
    mark = rng.choice(list(marks))
    places = [found.start() for found in re.finditer(re.escape(mark), content)]
    if not places:
        return _bytes(content, rng)
    start, field = rng.choice(places), rng.choice(list(marks[mark]))
    values = (0, 1, 8, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, rng.getrandbits(32))
    width = rng.choice((2, 4))
    value = rng.choice(values) & (256**width - 1)
    data[start + field : start + field + width] = value.to_bytes(width, "little")
    return bytes(data)


def _npy_header(descr: str, shape: tuple[int, ...], fortran: bool = False) -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': {fortran}, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def _npy(content: bytes, rng: random.Random) -> bytes:
    """An array whose header differs from its content, or that is cut or flipped."""
    if rng.random() < 0.4 or len(content) < 10:
        return _bytes(content, rng)
    length = struct.unpack("<H", content[8:10])[0]
    text, data = content[10 : 10 + length], content[10 + length :]
    if rng.random() < 0.5:
        shapes = (
            (),
            (0,),
            (2**31,),
            (10**12, 3),
            (-1,),
            (1, 1, 8),
            (2**63, 2),
            (7,) * 40,
        )
        codes = (*TYPES, "O", "|V16", "<f8", "(2,)<f8", "<U999999", "<f3", "i8,i8", "x")
        return _npy_header(rng.choice(codes), rng.choice(shapes)) + data
    text = _text(text, rng)[:60_000]
    return content[:8] + struct.pack("<H", len(text)) + text + data


# Pickles

_GROWTH = b"(lp0\n" + b"".join(
    b"(g%d\ng%d\ng%d\nlp%d\n" % (k, k, k, k + 1) for k in range(40)
)
_OPCODES = [
    bytes([code])
    for code in b"(.012NQRabcdeghijlopqrstu}])"
    b"\x81\x85\x86\x87\x88\x94\x93\x92\x8f\x90\x91"
]


def _opcodes(content: bytes, rng: random.Random) -> bytes:
    """Instructions left out, repeated, exchanged, put in or with other arguments."""
    start = 0
    packed = None
    if content[:1] == b"x":
        try:
            packed = zlib.decompress(content)
        except zlib.error:
            return _bytes(content, rng)
    data = content if packed is None else packed
    try:
        found = [(place, op, arg) for op, arg, place in pickletools.genops(data)]
    except Exception:
        return _bytes(content, rng)
    places = [place for place, _, _ in found] + [len(data)]
    parts = [data[a:b] for a, b in zip(places, places[1:])]
    if not parts:
        return _bytes(content, rng)
    for _ in range(rng.choice((1, 1, 2, 4))):
        k = rng.randrange(len(parts))
        action = rng.randrange(8)
        if action == 0:
            del parts[k]
        elif action == 1:
            parts.insert(k, parts[k])
        elif action == 2:
            j = rng.randrange(len(parts))
            parts[j], parts[k] = parts[k], parts[j]
        elif action == 3:
            parts[k] = rng.choice(_OPCODES)
        elif action == 4:
            parts.insert(k, rng.choice(_OPCODES))
        elif action == 5:
            value = rng.choice([n for n in NUMBERS if not isinstance(n, float)])
            parts[k] = pickle.dumps(value, 2)[2:-1]
        elif action == 6 and len(parts[k]) > 1:
            at = rng.randrange(1, len(parts[k]))
            part = bytearray(parts[k])
            part[at] ^= 1 << rng.randrange(8)
            parts[k] = bytes(part)
        else:
            parts.insert(k, rng.choice([_GROWTH, b"(" * 500, b"]" * 2000, b"\x80\x7f"]))
        if not parts:
            break
    result = data[:start] + b"".join(parts)
    return result if packed is None else zlib.compress(result)


# Bytes


def _bytes(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return rng.randbytes(rng.choice((0, 1, 8, 100)))
    data, roll = bytearray(content), rng.random()
    at = rng.randrange(len(data))
    if roll < 0.4:
        for _ in range(rng.choice((1, 1, 2, 8))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif roll < 0.55:
        del data[at:]
    elif roll < 0.65:
        size = rng.choice((1, 4, 8, 64))
        source = rng.randrange(len(data))
        data[at : at + size] = data[source : source + size]
    elif roll < 0.85:
        width = rng.choice((1, 2, 4, 8))
        value = rng.choice((0, 1, 0x7F, 0xFF, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1))
        raw = (value % 256**width).to_bytes(width, rng.choice(("little", "big")))
        data[at : at + width] = raw
    elif roll < 0.92:
        number = struct.pack("<d", float(rng.choice((math.nan, math.inf, 1e308, -1))))
        at -= at % 8
        data[at : at + 8] = number
    elif roll < 0.96:
        data[at:at] = rng.randbytes(rng.choice((1, 7, 300)))
    else:
        del data[at : at + rng.choice((1, 8, 300))]
    return bytes(data)
