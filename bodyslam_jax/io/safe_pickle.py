"""Reads pickled files without running the code in them.

Pickle, joblib, PyTorch's zip files and object arrays of NumPy can hold code that runs
on loading. Here they are unpacked within a budget, and run by an interpreter
(`pickle_machine`) that makes plain data only: numbers, text, lists, dictionaries and
new arrays. Objects of libraries that the caller names become inert stand-ins that keep
their state.
"""

import bz2
import lzma
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import plain_arrays
from bodyslam_jax.io.pickle_instructions import STEPS
from bodyslam_jax.io.pickle_machine import Machine, Name, StandIn, Storage
from bodyslam_jax.io.pickle_names import CALLS, INERT, STORAGES
from bodyslam_jax.io.plain_arrays import Account, Damaged, Refused, shown

__all__ = ["StandIn", "restricted_load"]

_BLOCK_BYTES = 1 << 20
_MAX_INDEX_BYTES = 16_000_000
"""Largest list of files in a zip archive, bytes: some 200,000 names."""
_LZMA_BYTES = 256 << 20
"""Working memory of xz and lzma, bytes; their highest preset takes 65 MiB."""
_TEXT_PICKLES = (b"(", b"c", b"}", b"]")
"""First bytes of containers and objects in protocols 0 and 1, which have no magic
number."""
_OLD_TORCH = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."


class _PlainMachine(Machine):
    """The machine with the instructions and names of result files."""

    instructions, calls, inert = STEPS, CALLS, INERT


def restricted_load(path: Path, stand_ins: tuple[str, ...] = ()) -> Any:
    """Loads a pickle, joblib, `.pt`, `.npz` or `.npy` file made of plain data.

    Tensors become NumPy arrays, and arrays of objects nested lists. Arrays are new,
    writable, by row, and in the machine's order of bytes.

    Args:
        stand_ins: packages, such as `"scipy.sparse"`, whose objects become `StandIn`s
            instead of being refused. The packages are not imported.

    **Raises:** `InputError`, one line that names the file, if it is damaged, holds
    anything else, or makes more than 1 GB.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            account = Account(size)
            account.check(size, "a file")
            # The longest of the signatures below has fewer.
            head = file.read(16)
            file.seek(0)
            if head.startswith(b"PK\x03\x04"):
                return _load_zip(file, size, account, stand_ins)
            if head.startswith(b"\x93NUMPY"):
                return _load_array(file, size, account, stand_ins)
            return _load_pickle(file, head, account, stand_ins)
    except Refused as error:
        raise InputError(
            f"{path}: refused, {error}; expected plain data (numbers, text, lists, "
            "dictionaries, arrays)."
        ) from None
    except (MemoryError, RecursionError, Exception) as error:
        # A damaged file can fail anywhere, with any error.
        if isinstance(error, OSError) and error.filename is not None:
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
        kind = "" if isinstance(error, Damaged) else f"{type(error).__name__}: "
        what = " ".join(f"{kind}{error}".split())[:150]
        raise InputError(
            f"{path}: not a readable result file ({what}); expected a whole pickle, "
            "joblib, .pt, .npz or .npy file."
        ) from None


def _load_pickle(
    file: Any, head: bytes, account: Account, stand_ins: tuple[str, ...]
) -> Any:
    """Loads the file of pickle or joblib, compressed or not."""
    if head.startswith(b'\x04"M\x18'):
        raise Refused(
            "it is packed with lz4, expected zlib, gzip, bz2, xz or no packing"
        )
    data = _unpacked(file, head, account)
    if data.startswith(_OLD_TORCH):
        raise Refused(
            "it is PyTorch's format before version 1.6, expected the one of today "
            "(load it in PyTorch and save it again)"
        )
    if not data.startswith((b"\x80", *_TEXT_PICKLES)):
        raise Damaged("neither a pickle nor an archive")
    account.spend(len(data))
    return _PlainMachine(data, 0, account, stand_ins).load()


def _unpacked(file: Any, head: bytes, account: Account) -> bytes | bytearray:
    """Returns the whole file, unpacked. joblib's files look like what they are
    compressed with."""
    unpackers = {
        b"x": zlib.decompressobj,
        # 16 asks zlib for the head of gzip.
        b"\x1f\x8b": lambda: zlib.decompressobj(zlib.MAX_WBITS | 16),
        b"BZh": bz2.BZ2Decompressor,
        b"\xfd7zXZ": lambda: lzma.LZMADecompressor(memlimit=_LZMA_BYTES),
        b"]\x00": lambda: lzma.LZMADecompressor(memlimit=_LZMA_BYTES),
    }
    make = next((unpackers[k] for k in unpackers if head.startswith(k)), None)
    if make is None:
        return file.read()
    unpacker: Any = make()
    out = bytearray()
    while not unpacker.eof:
        block = file.read(_BLOCK_BYTES)
        if not block:
            out += unpacker.flush() if hasattr(unpacker, "flush") else b""
            if unpacker.eof:
                break
            raise Damaged(f"its compressed part is cut short after {len(out)} bytes")
        # What does not fit one step is kept by bz2 and xz, and handed back by zlib.
        while block or not getattr(unpacker, "needs_input", True):
            out += unpacker.decompress(block, _BLOCK_BYTES)
            account.check_unpacked(len(out))
            block = getattr(unpacker, "unconsumed_tail", b"")
            if unpacker.eof:
                break
    return out


def _taken(file: Any, count: int) -> bytearray:
    """Returns exactly `count` bytes, which must be the last; so an archive's checksum
    is read.

    **Raises:** `Damaged` if there are more or fewer.
    """
    found = bytearray()
    while len(found) <= count:
        block = file.read(min(_BLOCK_BYTES, count + 1 - len(found)))
        if not block:
            break
        found += block
    if len(found) != count:
        raise Damaged(
            f"{count} bytes, {'more' if len(found) > count else len(found)} are there"
        )
    return found


def _load_array(
    file: Any, size: int, account: Account, stand_ins: tuple[str, ...]
) -> Any:
    """Reads one array in NumPy's format; a lone pickled object is returned as it is.

    Args:
        size: bytes of the array with its head, as far as the file or archive tells.
    """
    of, shape, by_column, used = plain_arrays.read_header(file)
    if of.kind == "O":
        # The head of an array of objects repeats what its pickle says.
        account.check(size, "an array of objects")
        data = _taken(file, size - used)
        account.spend(len(data))
        return _PlainMachine(data, 0, account, stand_ins).load()
    wanted = plain_arrays.num_bytes(of, shape, account)
    if wanted != size - used:
        what = f"an array {of.code}{shape} has {wanted} bytes"
        raise Damaged(f"{what}, {size - used} are there")
    if by_column:
        account.spend(wanted)
    return plain_arrays.array_of(_taken(file, wanted), of, shape, account, by_column)


class _Guarded:
    """A file from which readers cannot take more at once than an index needs."""

    def __init__(self, file: Any, size: int) -> None:
        self.seek, self.tell, self._file, self._size = file.seek, file.tell, file, size

    def seekable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self._file.tell(), 0)
        if min(size if size >= 0 else left, left) > _MAX_INDEX_BYTES:
            raise Refused(
                f"an archive with an index of more than {_MAX_INDEX_BYTES} bytes"
            )
        return self._file.read(size)


def _load_zip(
    file: Any, size: int, account: Account, stand_ins: tuple[str, ...]
) -> Any:
    """Loads a `.pt` of PyTorch 1.6 or later; or an `.npz`, as a dictionary."""
    with zipfile.ZipFile(_Guarded(file, size)) as archive:  # pyright: ignore
        members = {entry.filename: entry for entry in archive.infolist()}
        if len(members) < len(archive.infolist()):
            raise Refused("an archive with two files of one name")
        packings = {entry.compress_type for entry in members.values()}
        if not packings <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise Refused("an archive packed otherwise than by deflate")
        account.check_unpacked(sum(entry.file_size for entry in members.values()))
        pickles = [name for name in members if name.endswith("/data.pkl")]
        if len(pickles) > 1:
            raise Refused(f"{len(pickles)} pickles in one archive")
        if pickles:
            return _Torch(archive, pickles[0], account, stand_ins).load()
        found = {}
        for name, entry in members.items():
            if not name.endswith(".npy"):
                continue
            with archive.open(entry) as member:
                array = _load_array(member, entry.file_size, account, stand_ins)
                found[name.removesuffix(".npy")] = array
        return found


class _Torch:
    """PyTorch's archive: a pickle, and beside it the numbers of each storage."""

    def __init__(
        self,
        archive: zipfile.ZipFile,
        name: str,
        account: Account,
        stand_ins: tuple[str, ...],
    ) -> None:
        self.archive, self.folder = archive, name.removesuffix("data.pkl")
        self.account, self.stand_ins = account, stand_ins
        self.storages: dict[tuple[str, str], Storage] = {}

    def load(self) -> Any:
        order = f"{self.folder}byteorder"
        if order in self.archive.namelist() and self._read(order) != b"little":
            raise Refused("numbers whose most significant byte comes first")
        data = self._read(f"{self.folder}data.pkl")
        self.account.spend(len(data))
        return _PlainMachine(data, 0, self.account, self.stand_ins, self.storage).load()

    def storage(self, pid: Any) -> Storage:
        """Returns the storage that a reference of the pickle names."""
        # "storage", type, key, place, number (`torch.save`).
        if type(pid) is not tuple or len(pid) != 5 or pid[0] != "storage":
            raise Refused("it refers to data outside the file")
        _, kind, key, _, count = pid
        code = STORAGES.get(kind.key) if isinstance(kind, Name) else None
        if code is None or type(key) is not str or type(count) is not int:
            raise Refused(f"it refers to a storage {shown(key)} of an unknown type")
        known = self.storages.get((kind.key, key))
        if known is None:
            of = plain_arrays.array_type(code)
            content = self._read(f"{self.folder}data/{key}")
            shape = (len(content) // of.size,)
            numbers = plain_arrays.array_of(content, of, shape, self.account)
            known = Storage(of, numbers, kind.key == "torch.BFloat16Storage")
            self.storages[kind.key, key] = known
        if len(known.numbers) != count:
            what = f"a storage of {count} numbers"
            raise Damaged(f"{what}, {len(known.numbers)} are there")
        return known

    def _read(self, name: str) -> bytearray:
        entry = self.archive.getinfo(name)
        with self.archive.open(entry) as member:
            return _taken(member, entry.file_size)
