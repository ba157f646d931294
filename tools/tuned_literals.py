"""Counts the numbers of the package that somebody chose, file by file.

    python tools/tuned_literals.py [FOLDER] [--list] [--without-source]

A literal counts if it is neither structure nor a unit. Structure is: 0, 1 and 2 and
their negatives, a half, indices and slices, axes, shapes and sizes of arrays, ranges,
numbers inside text, exponents of powers, integers in a table (a tuple or list of more
than three), and the dimensions of vectors, rotations and body models. Units are powers
of ten, and what converts degrees, minutes, bytes and colours. A number has a source if
a docstring follows its name, a comment is on its line or before it (or before the
statement of several lines that it is in), or it is an argument of a call that names its
`source`. The look of charts (sizes of fonts and lines) is no estimate and does not
count. `--list` prints every literal, `--without-source` only those without one.
"""

import argparse
import ast
import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

_STRUCTURE = {0, 1, 2, 0.5}
_DIMENSIONS = {3, 4, 6, 9, 12, 21, 22, 23, 24, 25, 63, 66, 69, 72, 207}
_UNITS = {60, 90, 180, 255, 256, 360, 1024, 3600}
_SHAPES = {
    *("reshape", "zeros", "ones", "full", "eye", "empty", "broadcast_to", "tile"),
    *("repeat", "expand_dims", "swapaxes", "moveaxis", "transpose", "range", "arange"),
    *("round", "split", "rsplit", "take", "stack", "concatenate", "ljust", "rjust"),
}
_NOT_CHOSEN = {
    *("axis", "ndim", "dtype", "indent", "stacklevel", "width", "decimals"),
    # The look of a chart: no estimate depends on it.
    *("fontsize", "title_fontsize", "markersize", "lw", "linewidth", "dpi", "alpha"),
    *("rotation", "figsize", "ncols", "zorder"),
}


@dataclasses.dataclass(frozen=True)
class Literal:
    """A number that somebody chose."""

    line: int
    name: str
    """Of the constant, field or function that it is in."""
    value: float
    has_source: bool


def literals(text: str) -> list[Literal]:
    """The tuned literals of a module."""
    tree = ast.parse(text)
    lines = text.splitlines()
    commented = {k + 1 for k, line in enumerate(lines) if "#" in line}
    documented = _documented(tree) | _below_a_comment(tree, lines)
    found = []
    place = lambda one: (one[0].lineno, one[0].col_offset)
    for node, name in sorted(_numbers(tree, "module"), key=place):
        line = node.lineno
        known = line in commented or line - 1 in commented or line in documented
        found.append(Literal(line, name, node.value, known))
    return found


def _documented(tree: ast.AST) -> set[int]:
    """Lines of assignments that a docstring follows, and of calls with a `source`."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and "source" in [k.arg for k in node.keywords]:
            found |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for one, after in zip(body, body[1:]):
            is_text = isinstance(after, ast.Expr) and isinstance(
                after.value, ast.Constant
            )
            if isinstance(one, ast.Assign | ast.AnnAssign) and is_text:
                found |= set(range(one.lineno, (one.end_lineno or one.lineno) + 1))
    return found


def _below_a_comment(tree: ast.AST, lines: list[str]) -> set[int]:
    """Lines of simple statements that a line of comment precedes."""
    found = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.stmt) or hasattr(node, "body"):
            continue
        if lines[node.lineno - 2].lstrip().startswith("#"):
            found |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return found


def _numbers(node: ast.AST, name: str) -> Iterator[tuple[ast.Constant, str]]:
    """Numbers below a node that are neither structure nor units, with the name of what
    they are in."""
    if isinstance(node, ast.Constant):
        if _is_chosen(node.value):
            yield node, name
        return
    if isinstance(node, ast.Subscript):
        yield from _numbers(node.value, name)
        return
    if isinstance(node, ast.JoinedStr) or _is_annotation(node):
        return
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        name = node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        name = target.id if isinstance(target, ast.Name) else name
    for field, child in ast.iter_fields(node):
        for one in child if isinstance(child, list) else [child]:
            if not isinstance(one, ast.AST) or field in ("annotation", "returns"):
                continue
            if _is_structure(node, field, one):
                continue
            yield from _numbers(one, name)


def _is_structure(node: ast.AST, field: str, child: ast.AST) -> bool:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        return field == "right"
    if isinstance(node, ast.Call) and field == "args":
        called = node.func
        label = called.attr if isinstance(called, ast.Attribute) else None
        label = called.id if isinstance(called, ast.Name) else label
        return label in _SHAPES
    if isinstance(node, ast.keyword) and node.arg in _NOT_CHOSEN:
        return True
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        whole = [one for one in node.elts if isinstance(one, ast.Constant)]
        return len(whole) > 3 and all(isinstance(one.value, int) for one in whole)
    return False


def _is_annotation(node: ast.AST) -> bool:
    return isinstance(node, ast.arg)


def _is_chosen(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    size = abs(value)
    if size in _STRUCTURE or size in _UNITS:
        return False
    if isinstance(value, int) and size in _DIMENSIONS:
        return False
    power = f"{size:e}"
    return not power.startswith("1.000000e")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = Path(__file__).parents[1] / "bodyslam_jax"
    parser.add_argument("folder", type=Path, nargs="?", default=default)
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--without-source", action="store_true")
    options = parser.parse_args()
    count: Counter[str] = Counter()
    bare: Counter[str] = Counter()
    for file in sorted(options.folder.rglob("*.py")):
        name = str(file.relative_to(options.folder))
        for one in literals(file.read_text()):
            count[name] += 1
            bare[name] += not one.has_source
            wanted = options.list or (options.without_source and not one.has_source)
            if wanted and not (options.without_source and one.has_source):
                print(f"{name}:{one.line}: {one.name}: {one.value:g}")
    if not (options.list or options.without_source):
        print("chosen, without a source, where")
        rooms: Counter[str] = Counter()
        for name, number in count.items():
            rooms[name.split("/")[0] + "/" * ("/" in name)] += number
        for name, number in rooms.most_common():
            print(f"{number:5}        {name}")
        for name, number in count.most_common():
            print(f"{number:5} {bare[name]:5}  {name}")
    print(f"{count.total()} tuned literals in {len(count)} files,", end=" ")
    print(f"{bare.total()} without a source beside them")


if __name__ == "__main__":
    main()
