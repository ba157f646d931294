"""The instructions of pickles, each a function that changes a machine.

They are those of protocols 0 to 5, documented in CPython's `pickletools`.
"""

import codecs
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from bodyslam_jax.io.pickle_machine import (
    BLOB_BYTES,
    OBJECT_BYTES,
    REFERENCE_BYTES,
    Blob,
    Instruction,
    Machine,
)
from bodyslam_jax.io.plain_arrays import VALUE_BYTES, Damaged, Refused, shown


def _whole(value: int) -> int:
    """Returns a whole number that fits 64 bits; later code converts it to such."""
    if not -(2**63) <= value < 2**64:
        raise Refused("a whole number of more than 64 bits")
    return value


def _fixed(layout: str) -> Instruction:
    number = struct.Struct(layout)
    return lambda machine: machine.push(machine.number(number))


def _constant(value: Any) -> Instruction:
    return lambda machine: machine.push(value)


def _long(layout: str) -> Instruction:
    width = struct.Struct(layout)

    def step(machine: Machine) -> None:
        count = machine.number(width)
        if not 0 <= count <= 9:
            raise Refused("a whole number of more than 64 bits")
        value = int.from_bytes(machine.bytes_at(count), "little", signed=True)
        machine.push(_whole(value))

    return step


def _written_int(machine: Machine) -> None:
    text = machine.line()
    if text in (b"00", b"01"):
        return machine.push(text == b"01")
    if not re.fullmatch(rb"[+-]?\d{1,20}L?", text):
        raise Damaged(f"{text[:40]!r} as a whole number")
    machine.push(_whole(int(text.rstrip(b"L"))))


def _written_float(machine: Machine) -> None:
    text = machine.line()
    if not re.fullmatch(rb"[+-]?(\d+\.?\d*|\.\d+|inf|nan)(e[+-]?\d+)?", text.lower()):
        raise Damaged(f"{text[:40]!r} as a number")
    machine.push(float(text))


def _written_string(machine: Machine) -> None:
    """Pushes a text of Python 2, in quotes."""
    text = machine.line(len(machine.data))
    if len(text) < 2 or text[:1] not in b"'\"" or text[:1] != text[-1:]:
        raise Damaged(f"{text[:40]!r} as a text in quotes")
    machine.account.spend(2 * len(text))
    plain: Any = codecs.escape_decode(text[1:-1])[0]  # pyright: ignore
    machine.push(plain.decode("latin1"))


def _written_unicode(machine: Machine) -> None:
    line = machine.line(len(machine.data))
    machine.account.spend(4 * len(line))
    text = line.decode("raw-unicode-escape")
    if not text.isascii():
        text.encode("utf-8")  # fails for halves of characters: no file takes them
    machine.push(text)


def _sized(layout: str, kind: type, is_text: bool = False) -> Instruction:
    """Returns the instruction that pushes bytes, or a text, preceded by their
    length."""
    width = struct.Struct(layout)

    def step(machine: Machine) -> None:
        count = machine.number(width)
        if count < 0:
            raise Damaged(f"a text of {count} characters")
        view = machine.bytes_at(count)
        if kind is str:
            # One character beyond latin1 makes all of a text four bytes wide.
            is_wide = count < BLOB_BYTES or np.frombuffer(view, "u1").max() > 0xC3
            machine.account.spend(4 * count if is_wide else count)
            return machine.push(str(view, "utf-8"))
        if count >= BLOB_BYTES:
            return machine.push(Blob(view, is_text), OBJECT_BYTES)
        value = str(view, "latin1") if is_text else bytes(view)
        machine.push(value, VALUE_BYTES + count)

    return step


def _tuple_of(count: int) -> Instruction:
    def step(machine: Machine) -> None:
        if len(machine.stack) < count:
            raise Damaged("a tuple of more objects than there are")
        items = tuple(machine.stack[len(machine.stack) - count :])
        del machine.stack[len(machine.stack) - count :]
        machine.push(items, 2 * VALUE_BYTES)

    return step


def _of_marked(make: Callable[[Machine, list], Any]) -> Instruction:
    """Returns the instruction that pushes a container of all objects above the mark."""

    def step(machine: Machine) -> None:
        items = machine.pop_mark()
        machine.push(make(machine, items), OBJECT_BYTES + REFERENCE_BYTES * len(items))

    return step


def _marked_dict(machine: Machine, items: list) -> dict:
    found: dict[Any, Any] = {}
    machine.set_items(found, items)
    return found


def _empty(make: Callable[[], Any]) -> Instruction:
    return lambda machine: machine.push(make(), OBJECT_BYTES)


def _mark(machine: Machine) -> None:
    machine.account.spend(2 * VALUE_BYTES)
    machine.marked.append(machine.stack)
    machine.stack = []


def _pop(machine: Machine) -> None:
    if machine.stack:
        machine.stack.pop()
    else:
        machine.pop_mark()


def _pop_mark(machine: Machine) -> None:
    machine.pop_mark()


def _append(machine: Machine) -> None:
    item = machine.stack.pop()
    machine.extend(machine.stack[-1], [item])


def _appends(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.extend(machine.stack[-1], items)


def _set_item(machine: Machine) -> None:
    value, key = machine.stack.pop(), machine.stack.pop()
    machine.set_items(machine.stack[-1], [key, value])


def _set_items(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.set_items(machine.stack[-1], items)


def _add_items(machine: Machine) -> None:
    items, target = machine.pop_mark(), machine.stack[-1]
    if type(target) is not set:
        raise Refused(f"it wants to change {shown(target)}")
    target.update(machine.set_of(items))


def _put(layout: str) -> Instruction:
    place = struct.Struct(layout)
    return lambda machine: machine.remember(machine.number(place))


def _get(layout: str) -> Instruction:
    place = struct.Struct(layout)
    return lambda machine: machine.push(
        machine.memo[machine.number(place)], REFERENCE_BYTES
    )


def _place(machine: Machine) -> int:
    text = machine.line()
    if not re.fullmatch(rb"\d{1,10}", text):
        raise Damaged(f"{text[:40]!r} as a number of an object")
    return int(text)


def _global(machine: Machine) -> None:
    module, name = machine.line().decode(), machine.line().decode()
    machine.push(machine.named(module, name), REFERENCE_BYTES)


def _stack_global(machine: Machine) -> None:
    name, module = machine.stack.pop(), machine.stack.pop()
    machine.push(machine.named(module, name), REFERENCE_BYTES)


def _reduce(machine: Machine) -> None:
    arguments, function = machine.stack.pop(), machine.stack.pop()
    machine.call(function, arguments)


def _new_with_names(machine: Machine) -> None:
    named = machine.stack.pop()
    if named != {}:
        raise Refused("it wants to make an object with named arguments")
    _reduce(machine)


def _instance(machine: Machine) -> None:
    """Pushes an object of an old class of Python 2, by its name."""
    of = machine.named(machine.line().decode(), machine.line().decode())
    machine.call(of, tuple(machine.pop_mark()))


def _object(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.call(items[0], tuple(items[1:]))


def _reference(machine: Machine) -> None:
    pid = machine.stack.pop()
    if machine.persistent is None:
        raise Refused("it refers to data outside the file")
    machine.push(machine.persistent(pid), OBJECT_BYTES)


def _outside(_: Machine) -> None:
    raise Refused("it refers to data outside the file")


def _protocol(machine: Machine) -> None:
    (version,) = machine.bytes_at(1)
    # The last protocol of Python.
    if version > 5:
        raise Refused(f"a pickle of protocol {version}, expected 0 to 5")


def _frame(machine: Machine) -> None:
    """Checks the length of a frame, which only readers in parts need."""
    length = machine.number(struct.Struct("<Q"))
    if length > len(machine.data) - machine.at:
        raise Damaged(f"{length} bytes, {len(machine.data) - machine.at} are there")


STEPS: dict[int, Instruction] = {
    ord(code): step
    for code, step in {
        "(": _mark,
        "0": _pop,
        "1": _pop_mark,
        "2": lambda machine: machine.push(machine.stack[-1], 8),
        "F": _written_float,
        "G": _fixed(">d"),
        "I": _written_int,
        "J": _fixed("<i"),
        "K": _fixed("<B"),
        "M": _fixed("<H"),
        "L": _written_int,
        "\x8a": _long("<B"),
        "\x8b": _long("<i"),
        "N": _constant(None),
        "\x88": _constant(True),
        "\x89": _constant(False),
        "S": _written_string,
        "T": _sized("<i", bytes, is_text=True),
        "U": _sized("<B", bytes, is_text=True),
        "B": _sized("<I", bytes),
        "C": _sized("<B", bytes),
        "\x8e": _sized("<Q", bytes),
        "\x96": _sized("<Q", bytes),
        "V": _written_unicode,
        "X": _sized("<I", str),
        "\x8c": _sized("<B", str),
        "\x8d": _sized("<Q", str),
        ")": _empty(tuple),
        "t": _of_marked(lambda _, items: tuple(items)),
        "\x85": _tuple_of(1),
        "\x86": _tuple_of(2),
        "\x87": _tuple_of(3),
        "]": _empty(list),
        "l": _of_marked(lambda _, items: items),
        "a": _append,
        "e": _appends,
        "}": _empty(dict),
        "d": _of_marked(_marked_dict),
        "s": _set_item,
        "u": _set_items,
        "\x8f": _empty(set),
        "\x90": _add_items,
        "\x91": _of_marked(lambda machine, items: machine.set_of(items)),
        "c": _global,
        "\x93": _stack_global,
        "R": _reduce,
        "\x81": _reduce,
        "\x92": _new_with_names,
        "i": _instance,
        "o": _object,
        "b": lambda machine: machine.build(),
        "p": lambda machine: machine.remember(_place(machine)),
        "q": _put("<B"),
        "r": _put("<I"),
        "\x94": lambda machine: machine.remember(len(machine.memo)),
        "g": lambda machine: machine.push(machine.memo[_place(machine)], 8),
        "h": _get("<B"),
        "j": _get("<I"),
        "P": _outside,
        "Q": _reference,
        "\x97": _outside,
        "\x98": _outside,
        "\x80": _protocol,
        "\x95": _frame,
    }.items()
}
"""The instructions by their codes; those that import through a registry are missing."""
