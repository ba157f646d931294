"""Files that attack or exhaust who loads them, and those of tools, which are read."""

import bz2
import collections
import gzip
import io
import lzma
import pickle
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import plain_arrays
from bodyslam_jax.io.safe_pickle import StandIn, restricted_load

HOSTILE = Path(__file__).parents[2] / "shared" / "cases" / "files"
PLAIN = (int, float, complex, bool, str, bytes, type(None), slice)


def refusal(path: Path, content: bytes) -> str:
    """The one line with which a file is refused, in seconds."""
    path.write_bytes(content)
    start = time.process_time()
    with pytest.raises(InputError) as caught:
        restricted_load(path)
    assert (
        time.process_time() - start < 5
    )  # a fifth on a machine that does nothing else
    message = str(caught.value)
    assert "\n" not in message and str(path) in message and "expected" in message
    return message


def assert_plain(found, depth=0):
    assert depth < 70
    if isinstance(found, np.ndarray):
        assert found.dtype.kind in "biufcSU" and found.dtype.isnative
        assert found.flags.writeable and found.flags.c_contiguous
        found.tolist()
    elif isinstance(found, dict):
        for key, value in found.items():
            assert isinstance(key, (*PLAIN, tuple))
            assert_plain(value, depth + 1)
    elif isinstance(found, list | tuple | set | frozenset):
        for value in found:
            assert_plain(value, depth + 1)
    else:
        assert type(found) in PLAIN


def loads_or_refuses(path: Path, content: bytes) -> bool:
    """Whether a damaged file is read; if so, to plain data, else with one line."""
    path.write_bytes(content)
    try:
        assert_plain(restricted_load(path))
        return True
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return False


# Instructions, by hand


def text(word: str) -> bytes:
    return b"\x8c" + bytes([len(word)]) + word.encode()


def whole(n: int) -> bytes:
    return b"\x8a\x09" + n.to_bytes(9, "little", signed=True)


def shape(*axes: int) -> bytes:
    return b"(" + b"".join(map(whole, axes)) + b"t"


def dtype(code: str, state: bytes = b"") -> bytes:
    made = b"cnumpy\ndtype\n" + text(code) + b"\x89\x88\x87R"
    return made + (state + b"b" if state else b"")


EMPTY = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"


def ndarray(of: bytes, axes: bytes, content: bytes, by_column: bytes = b"\x89"):
    raw = b"B" + struct.pack("<I", len(content)) + content
    empty = (
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    )
    return empty + b"(K\x01" + axes + of + by_column + raw + b"tb"


def type_state(order="<", subtype=b"N", names=b"N", fields=b"N", size=-1, flags=0):
    head = b"(K\x03" + text(order) + subtype + names + fields
    return head + whole(size) + whole(-1) + whole(flags) + b"t"


def program(*parts: bytes) -> bytes:
    return b"\x80\x04" + b"".join(parts) + b"."


def laughs(levels: int, make: bytes = b"e", empty: bytes = b"]") -> bytes:
    parts = [empty, b"(", b"K\x00" * 10, make, b"q\x000"]
    for k in range(levels):
        get = b"h" + bytes([k])
        parts += [empty, b"(", get * 10, make, b"q", bytes([k + 1]), b"0"]
    return program(*parts, b"h" + bytes([levels]))


EIGHT = bytes(range(64))
BAD = {
    "fields": ndarray(
        dtype(
            "V8",
            type_state("|", names=text("a") + b"\x85", fields=b"}", size=8, flags=27),
        ),
        shape(8),
        EIGHT,
    ),
    "own item size": ndarray(dtype("f8", type_state(size=4096)), shape(8), EIGHT),
    "own flags": ndarray(dtype("f8", type_state(flags=63)), shape(8), EIGHT),
    "own subtype": ndarray(
        dtype("f8", type_state(subtype=dtype("f8") + shape(9) + b"\x86")),
        shape(8),
        EIGHT,
    ),
    "objects as bytes": ndarray(dtype("O8"), shape(8), EIGHT),
    "times": ndarray(dtype("M8[ns]"), shape(8), EIGHT),
    "long double": ndarray(dtype("f16"), shape(4), EIGHT),
    "no item size": ndarray(dtype("S0"), shape(8), b""),
    "huge item size": ndarray(dtype("U999999"), shape(0), b""),
    "too few bytes": ndarray(dtype("f8"), shape(9), EIGHT),
    "too many bytes": ndarray(dtype("f8"), shape(7), EIGHT),
    "negative axis": ndarray(dtype("f8"), shape(-8), EIGHT),
    "two negative axes": ndarray(dtype("f8"), shape(-4, -2), EIGHT),
    "product that wraps": ndarray(dtype("f8"), shape(2**61, 8, 2**60), b""),
    "empty but endless": ndarray(dtype("f8"), shape(0, 2**62), b""),
    "too many axes": ndarray(dtype("f8"), shape(*[1] * 70), EIGHT[:8]),
    "axis that is no number": ndarray(dtype("f8"), b"(G" + bytes(8) + b"t", EIGHT),
    "truth of 7": ndarray(dtype("b1"), shape(1), b"\x07"),
    "no character": ndarray(dtype("U1"), shape(1), b"\xff\xff\xff\x7f"),
    "half a character": ndarray(dtype("U1"), shape(1), b"\x00\xd8\x00\x00"),
    "array by its class": b"cnumpy\nndarray\n" + shape(8) + text("f8") + b"\x86R",
    "array of strides": b"cnumpy\nndarray\n("
    + shape(8)
    + text("f8")
    + b"C\x08"
    + bytes(8)
    + b"K\x00"
    + shape(0)
    + b"tR",
    "array never filled": EMPTY,
    "array filled with a list": b"cnumpy.core.multiarray\n_reconstruct\n"
    b"cnumpy\nndarray\nK\x00\x85C\x01b\x87R]b",
    "array of another class": b"cnumpy.core.multiarray\n_reconstruct\n"
    b"cbuiltins\nlist\nK\x00\x85C\x01b\x87R",
    "array in itself": b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00"
    b"\x85C\x01b\x87Rq\x00(K\x01K\x01\x85" + dtype("O") + b"\x89]h\x00atb",
    "scalar of objects": b"cnumpy.core.multiarray\nscalar\n"
    + dtype("O")
    + b"C\x01a\x86R",
    "list in itself": b"]q\x00h\x00a",
    "dictionary in itself": b"}q\x00K\x01h\x00s",
    "tuple in itself": b"]q\x00h\x00\x85q\x010h\x00h\x01a",
    "deep": b"]" + b"]" * 200 + b"a" * 200,
    "deep tuples": b"N" + b"\x85" * 5_000,
    "marks": b"(" * 5_000,
    "list as a key": b"}]K\x01s",
    "array as a key": b"}" + ndarray(dtype("f8"), shape(8), EIGHT) + b"K\x01s",
    "set of lists": b"\x8f(]\x90",
    "huge text": b"\x8d" + struct.pack("<Q", 2**62) + b"a",
    "huge bytes": b"\x8e" + struct.pack("<Q", 2**62) + b"a",
    "huge buffer": b"\x96" + struct.pack("<Q", 2**62) + b"a",
    "huge frame": b"\x95" + struct.pack("<Q", 2**62) + b"N",
    "negative length": b"T\xff\xff\xff\xffa",
    "buffer outside": b"\x97",
    "reference outside": b"P1\n",
    "registry": b"\x82\x01",
    "million digits": b"\x8b" + struct.pack("<i", 10**6) + b"\x7f" * 10**6,
    "million digits in words": b"L" + b"9" * 10**6 + b"L\n",
    "number of 65 bits": whole(2**64),
    "unknown instruction": b"\xff",
    "attribute of a list": b"]}" + text("append") + b"K\x01sb",
    "attribute of a dictionary": b"}}" + text("get") + b"K\x01sb",
    "items of an array": ndarray(dtype("f8"), shape(8), EIGHT) + b"K\x00K\x01s",
    "more of a tuple": b")K\x01a",
    "call of an array": ndarray(dtype("f8"), shape(8), EIGHT) + b")R",
    "call of a text": text("os.system") + b")R",
    "call without a tuple": b"cbuiltins\nlist\n]R",
    "named arguments": b"cbuiltins\ndict\n)}K\x01K\x02s\x92",
    "encoding": b"c_codecs\nencode\n" + text("a") + text("rot13") + b"\x86R",
    "text to repeat": b"c_codecs\nencode\nK\x05\x85R",
    "long list by number": b"cbuiltins\nlist\nJ\xff\xff\xff\x7f\x85R",
    "bytes by number": b"cbuiltins\nbytes\nJ\xff\xff\xff\x7f\x85R",
    "path of bytes": b"cpathlib\nPosixPath\nC\x01a\x85R",
    "getattr": b"cbuiltins\ngetattr\n",
    "dotted name": b"\x8c\x05numpy\x8c\x0endarray.tofile\x93",
    "name with a line break": b"\x8c\x03o\ns\x8c\x06system\x93",
    "name that is a number": b"K\x01K\x02\x93",
    "memo that is empty": b"h\x07",
    "stack that is empty": b"00",
    "two results": b"NN",
    "key without value": b"(K\x01d",
    "halves of characters": b"X\x03\x00\x00\x00\xed\xa0\x80",
    "torch without numbers": b"ctorch._utils\n_rebuild_tensor_v2\n(]K\x00K\x01\x85"
    b"K\x01\x85\x89NtR",
    "joblib without bytes": b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81}("
    + text("shape")
    + shape(10**9)
    + text("order")
    + text("C")
    + text("dtype")
    + dtype("u1")
    + b"ub",
}


@pytest.mark.parametrize("kind", BAD)
def test_hostile_pickles_are_refused(tmp_path, kind):
    refusal(tmp_path / "a.pkl", program(BAD[kind]))
    # The same as a value of something else, and packed.
    refusal(
        tmp_path / "b.pkl", zlib.compress(program(b"}" + text("x"), BAD[kind], b"s"))
    )


@pytest.mark.parametrize("make", [(b"e", b"]"), (b"t", b"")])
def test_repeated_references_are_counted_in_full(tmp_path, make):
    assert "repeated data" in refusal(tmp_path / "a.pkl", laughs(12, *make))
    assert "repeated data" in refusal(tmp_path / "b.pkl", laughs(40, *make))


def test_one_array_repeated_is_counted_in_full(tmp_path):
    array = ndarray(dtype("f8"), shape(1000, 100), bytes(800_000))
    content = program(b"(", array, b"q\x00", b"h\x00" * 2000, b"l")
    assert "repeated data" in refusal(tmp_path / "a.pkl", content)


@pytest.mark.parametrize(
    "name", ["a.zlib", "a.gz", "a.bz2", "a.xz", "a.lzma", "a.npz", "a.pt"]
)
def test_bombs_are_refused_before_they_are_unpacked(tmp_path, name, monkeypatch):
    assert plain_arrays.MAX_UNPACKED_BYTES <= 100_000_000
    # So many take seconds to pack.
    monkeypatch.setattr(plain_arrays, "MAX_UNPACKED_BYTES", 1_000_000)
    pack = {
        "a.zlib": zlib.compress,
        "a.gz": gzip.compress,
        "a.bz2": bz2.compress,
        "a.xz": lzma.compress,
        "a.lzma": lambda x: lzma.compress(x, format=lzma.FORMAT_ALONE),
    }
    size = 12_000_000
    if name in pack:
        content = pack[name](program(b"\x8e", struct.pack("<Q", size), bytes(size)))
    else:
        member = "a.npy" if name == "a.npz" else "a/data.pkl"
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(member, bytes(size))
        content = stream.getvalue()
    assert "unpacks to" in refusal(tmp_path / name, content)


def test_packed_instructions_are_bounded(tmp_path, monkeypatch):
    assert plain_arrays.FREE_STEPS <= 5_000_000
    # With types checked at run time, so many take a minute.
    monkeypatch.setattr(plain_arrays, "FREE_STEPS", 50_000)
    content = zlib.compress(program(b"N0" * 20_000, b"N"))
    (tmp_path / "a.pkl").write_bytes(content)
    restricted_load(tmp_path / "a.pkl")
    content = zlib.compress(program(b"N0" * 30_000, b"N"))
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(InputError, match="more instructions"):
        restricted_load(tmp_path / "a.pkl")


def test_keys_that_share_a_hash(tmp_path):
    """Tuples of numbers can be made to; a dictionary of them takes quadratic time."""
    same = b"".join(
        b"J" + struct.pack("<i", n) + b"J" + struct.pack("<i", k) + b"\x86N"
        for n in range(60)
        for k in (-1, -2)
    )
    found = program(b"(", same, b"d")
    (tmp_path / "a.pkl").write_bytes(found)
    assert len(restricted_load(tmp_path / "a.pkl")) == 120
    same = b"".join(
        b"(" + b"".join(b"J" + struct.pack("<i", -1 - (n >> i & 1)) for i in range(9))
        + b"tN"
        for n in range(400)
    )  # fmt: skip
    assert "slow" in refusal(tmp_path / "b.pkl", program(b"(", same, b"d"))


# Arrays in NumPy's format, in archives and alone

HEADS = {
    "deep": "(" * 5000,
    "long number": "{'descr': '<f8', 'fortran_order': False, 'shape': ("
    + "9" * 5000
    + ",), }",
    "structured": "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (3,), }",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-3,), }",
    "code": "{'descr': '<f8', 'fortran_order': exit(), 'shape': (3,), }",
    "twice": "{'descr': '<f8', 'descr': '<f8', 'shape': (3,), }",
    "too large": "{'descr': '<f8', 'fortran_order': False, 'shape': (300000000000,), }",
    "void": "{'descr': '|V8', 'fortran_order': False, 'shape': (3,), }",
    "date": "{'descr': '<M8[s]', 'fortran_order': False, 'shape': (3,), }",
}  # fmt: skip


@pytest.mark.parametrize("kind", HEADS)
def test_heads_of_arrays(tmp_path, kind):
    head = HEADS[kind].encode() + b"\n"
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(24)
    refusal(tmp_path / "a.npy", content)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("x.npy", content)
    refusal(tmp_path / "a.npz", stream.getvalue())


@pytest.mark.parametrize("by_column", [False, True])
@pytest.mark.parametrize("code", ["<f8", ">f4", "|b1", "<i2", ">U3", "|S4", "<c16"])
def test_arrays_come_back_as_they_were(tmp_path, code, by_column):
    array = np.arange(24).astype(code).reshape(2, 3, 4)
    array = np.asfortranarray(array) if by_column else array
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", x=array, empty=array[:, :0])
    for protocol in range(6):
        (tmp_path / f"{protocol}.pkl").write_bytes(pickle.dumps(array, protocol))
    turned = array.transpose(1, 0, 2)  # neither by row nor by column
    (tmp_path / "turned.pkl").write_bytes(pickle.dumps(turned, 5))
    files = [tmp_path / "a.npy", *tmp_path.glob("[0-5].pkl")]
    found = [restricted_load(file) for file in files]
    archive = restricted_load(tmp_path / "a.npz")
    assert archive["empty"].shape == (2, 0, 4)
    for one in (*found, archive["x"]):
        assert_plain(one)
        np.testing.assert_array_equal(one, array)
    np.testing.assert_array_equal(restricted_load(tmp_path / "turned.pkl"), turned)


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_of_every_protocol(tmp_path, protocol):
    data = {
        "numbers": [0, -1, 2**40, 2**63, 1.5, float("inf"), True, None, 1 + 2j],
        "text": ["", "é" * 300, "日本", "a\nb", "x" * 5000, "😀"],
        "bytes": [b"", b"ab\xff", b"y" * 5000, bytearray(b"z" * 5000)],
        "sets": [{1, 2}, frozenset({"a"})],
        ("tuple", 3): ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
        "ordered": collections.OrderedDict(a=1),
        "default": collections.defaultdict(list, {"a": [1]}),
        "deque": collections.deque([1, 2]),
        "slice": slice(1, None, 2),
        "scalars": [np.float32(0.5), np.int64(3), np.bool_(True), np.str_("ab")],
        "objects": np.array([{"a": 1}, None, "b", [1]], dtype=object),
        "table": np.array([["a", 1], ["b", 2]], dtype=object),
        "shared": [[1]] * 3,
        "path": Path("a") / "b",
        "empty": np.zeros((0, 3)),
    }
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(data, protocol))
    found = restricted_load(tmp_path / "a.pkl")
    assert_plain(found)
    for name in ("numbers", "text", "sets", "ordered", "default", "slice", "shared"):
        assert found[name] == data[name]
    assert found[("tuple", 3)] == data[("tuple", 3)]
    assert found["bytes"] == [bytes(x) for x in data["bytes"]]
    assert found["deque"] == [1, 2] and found["path"] == "a/b"
    assert found["scalars"] == [0.5, 3, True, "ab"]
    assert found["objects"] == [{"a": 1}, None, "b", [1]]
    assert found["table"] == [["a", 1], ["b", 2]]
    assert found["empty"].shape == (0, 3)


def test_python_2_wrote_arrays_as_text(tmp_path):
    """Its strings are bytes: names of 1 byte a character, and arrays' content."""
    numbers = np.linspace(-1, 1, 2000)
    raw = numbers.tobytes()
    content = (
        b"\x80\x02}U\x01aq\x00cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"
        b"K\x00\x85U\x01b\x87R(K\x01M\xd0\x07\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89T"
    )
    content += struct.pack("<i", len(raw)) + raw + b"tbs."
    (tmp_path / "a.pkl").write_bytes(content)
    np.testing.assert_array_equal(restricted_load(tmp_path / "a.pkl")["a"], numbers)


# joblib and PyTorch, whose files are laid out by hand as their programs do it


def small_joblib() -> bytes:
    wrapper = b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81}("
    parts = b""
    for name, array, aligned in (
        ("a", np.arange(6.0).reshape(2, 3), True),
        ("b", np.arange(3, dtype=np.uint8), False),
    ):
        head = text(name) + wrapper + text("shape") + shape(*array.shape)
        head += text("order") + text("C") + text("dtype") + dtype(array.dtype.str[1:])
        head += (text("numpy_array_alignment_bytes") + b"K\x10") if aligned else b""
        parts += head + b"ub" + (b"\x02\xff\xff" if aligned else b"") + array.tobytes()
    objects = text("c") + wrapper + text("shape") + shape(1) + text("order")
    objects += text("C") + text("dtype") + dtype("O8") + b"ub"
    objects += pickle.dumps(np.array([{"x": 1}], dtype=object), 2)
    return program(b"}(", parts, objects, b"u")


PACKS = [bytes, zlib.compress, gzip.compress, bz2.compress, lzma.compress]


@pytest.mark.parametrize("pack", PACKS)
def test_joblib_files_packed_or_not(tmp_path, pack):
    (tmp_path / "a.pkl").write_bytes(pack(small_joblib()))
    found = restricted_load(tmp_path / "a.pkl")
    np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(found["b"], np.arange(3))
    assert found["c"] == [{"x": 1}]


def test_lz4_and_old_torch_are_named(tmp_path):
    assert "lz4" in refusal(tmp_path / "a", b'\x04"M\x18' + bytes(20))
    old = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
    assert "before version 1.6" in refusal(tmp_path / "a.pth", old)


def torch_file(
    size, stride, numbers=np.arange(6, dtype="<f4"), offset=0, count=None, **more
) -> bytes:
    kind = more.get("kind", "FloatStorage").encode()
    pid = b"(" + text("storage") + b"ctorch\n" + kind + b"\n" + text("0") + text("cpu")
    pid += whole(len(numbers) if count is None else count) + b"tQ"
    view = whole(offset) + shape(*size) + shape(*stride) + b"\x89N"
    one = b"ctorch._utils\n_rebuild_tensor_v2\n(" + pid + view + b"tR"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("r/data.pkl", program(b"(", one, one, b"l"))
        archive.writestr("r/byteorder", more.get("order", "little"))
        archive.writestr("r/data/0", numbers.tobytes())
    return stream.getvalue()


def test_tensors(tmp_path):
    file = tmp_path / "a.pt"
    for size, stride, offset in (
        ((2, 3), (3, 1), 0),
        ((3, 2), (1, 3), 0),
        ((2,), (2,), 1),
        ((), (), 5),
        ((400, 6), (0, 1), 0),  # rows repeated, as `expand` makes them
        ((0, 9), (9, 1), 0),
    ):
        file.write_bytes(torch_file(size, stride, offset=offset))
        found = restricted_load(file)
        assert_plain(found)
        expected = np.lib.stride_tricks.as_strided(
            np.arange(6, dtype="<f4")[offset:], size, [4 * s for s in stride]
        )
        for one in found:
            np.testing.assert_array_equal(one, expected)
    half = np.array([1.0, -2.5, 3.0], np.float32).view(np.uint32) >> np.uint32(16)
    file.write_bytes(torch_file((3,), (1,), half.astype("<u2"), kind="BFloat16Storage"))
    np.testing.assert_array_equal(restricted_load(file)[0], [1.0, -2.5, 3.0])


@pytest.mark.parametrize(
    ("size", "stride", "more"),
    [
        ((500_000_000,), (0,), {}),
        ((5_000_000,), (0,), {}),
        ((2**40, 2**40), (0, 0), {}),
        ((7,), (1,), {}),
        ((2, 3), (2**62, 1), {}),
        ((3,), (-1,), {"offset": 5}),
        ((1,), (1,), {"offset": -1}),
        ((1,), (1,), {"offset": 6}),
        ((2, 3), (3,), {}),
        ((6,), (1,), {"count": 7}),
        ((6,), (1,), {"count": 2**40}),
        ((6,), (1,), {"count": -6}),
        ((6,), (1,), {"order": "big"}),
        ((6,), (1,), {"kind": "QInt8Storage"}),
        ((6,), (1,), {"kind": "BoolStorage", "count": 24}),
    ],
)
def test_tensors_beyond_their_storage(tmp_path, size, stride, more):
    refusal(tmp_path / "a.pt", torch_file(size, stride, **more))


def test_archives_that_lie(tmp_path):
    whole_file = torch_file((6,), (1,))
    where = whole_file.rindex(b"PK\x01\x02")  # the entry of the numbers
    for at, value in ((24, 2**31), (24, 8), (20, 5), (10, 99), (42, 2**30)):
        damaged = bytearray(whole_file)
        damaged[where + at : where + at + 2] = struct.pack("<I", value)[:2]
        damaged[where + at + 2 : where + at + 4] = struct.pack("<I", value)[2:]
        refusal(tmp_path / "a.pt", bytes(damaged))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("x.npy", b"a")
    assert "deflate" in refusal(tmp_path / "a.npz", stream.getvalue())
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive, pytest.warns(UserWarning):
        archive.writestr("x.npy", b"a")
        archive.writestr("x.npy", b"b")
    assert "one name" in refusal(tmp_path / "a.npz", stream.getvalue())


# Damage


def small_files() -> dict[str, bytes]:
    data = {
        "a": np.arange(3.0),
        1: [np.float32(2), "t", (1, None)],
        "u": np.array(["é"]),
    }
    npy, npz = io.BytesIO(), io.BytesIO()
    np.save(npy, np.array({"a": np.arange(2)}, dtype=object), allow_pickle=True)
    np.savez_compressed(npz, x=np.arange(4), y=np.array(["a"]))
    return {
        "0.pkl": pickle.dumps(data, 0),
        "2.pkl": pickle.dumps(data, 2),
        "4.pkl": pickle.dumps(data, 4),
        "5.pkl": pickle.dumps(data, 5),
        "j.pkl": small_joblib(),
        "z.pkl": zlib.compress(small_joblib()),
        "t.pt": torch_file((2, 3), (3, 1)),
        "o.npy": npy.getvalue(),
        "x.npz": npz.getvalue(),
    }


@pytest.mark.parametrize("name", small_files())
def test_files_cut_short(tmp_path, name):
    content = small_files()[name]
    assert loads_or_refuses(tmp_path / name, content)
    for end in range(0, len(content), 1 if len(content) < 500 else 3):
        assert not loads_or_refuses(tmp_path / name, content[:end]), end


@pytest.mark.parametrize("step", [37, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", small_files())
def test_flips_of_a_bit(tmp_path, name, step):
    content = small_files()[name]
    for at in range(0, 8 * len(content), step):
        damaged = bytearray(content)
        damaged[at // 8] ^= 1 << at % 8
        loads_or_refuses(tmp_path / name, bytes(damaged))


def test_stand_ins_keep_their_state(tmp_path):
    content = program(
        b"cscipy.sparse.csc\ncsc_matrix\n)\x81}", text("data"), b"K\x01s", b"b"
    )
    (tmp_path / "a.pkl").write_bytes(content)
    found = restricted_load(tmp_path / "a.pkl", ("scipy.sparse",))
    assert isinstance(found, StandIn) and found.name == "scipy.sparse.csc.csc_matrix"
    assert found.state == {"data": 1}
    assert "wants to load" in refusal(tmp_path / "a.pkl", content)


_CHILD = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
from pathlib import Path
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.safe_pickle import restricted_load
for name in sys.argv[1:]:
    try:
        restricted_load(Path(name))
    except InputError as error:
        assert name in str(error) and chr(10) not in str(error)
        print("refused")
# Of this program alone: what `getrusage` has counts the process of the tests, too.
status = Path("/proc/self/status").read_text()
print(next(x.split()[1] for x in status.splitlines() if x.startswith("VmHWM")))
"""


@pytest.mark.skipif(not HOSTILE.is_dir(), reason="needs the collected hostile files")
def test_collected_hostile_files():
    files = sorted([*HOSTILE.glob("*.pkl"), *HOSTILE.glob("*.pt")])
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, *map(str, files)],
        capture_output=True,
        text=True,
        timeout=100,
    )
    *refused, kilobytes = done.stdout.split()
    assert done.returncode == 0, done.stderr
    assert refused == ["refused"] * len(files) and int(kilobytes) < 2_000_000
