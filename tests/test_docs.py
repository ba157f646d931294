"""Code in README.md and docs/ runs: blocks of a page in order, in one program."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import bodyslam_jax
from bodyslam_jax import simulation
from bodyslam_jax.config import Simulation

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


OUTPUT = re.compile(r"^```output\n(.*?)^```", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def same(found: list[str], expected: list[str]) -> bool:
    """Whether lines have the same words, and the same numbers to 1 % or one of the last
    digit: machines round differently."""
    if [NUMBER.sub("#", line) for line in found] != [
        NUMBER.sub("#", line) for line in expected
    ]:
        return False
    numbers = lambda lines: [x for line in lines for x in NUMBER.findall(line)]
    return all(
        float(a) == pytest.approx(float(b), rel=0.01, abs=1.01 * last_digit(b))
        for a, b in zip(numbers(found), numbers(expected), strict=True)
    )


def last_digit(number: str) -> float:
    """What the last digit of a printed number counts."""
    digits, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))


def test_output_of_the_documentation_is_compared():
    assert same(["λ 51380: +0.0101 m"], ["λ 51383: +0.0100 m"])
    assert same(["-1.6e-06"], ["-1.7e-06"])
    assert not same(["λ 51383: +0.0102 m"], ["λ 51383: +0.0100 m"])
    assert not same(["λ 100: +0.0100 m"], ["λ 51383: +0.0100 m"])
    assert not same(["1.6e-06"], ["0.01 m"])


def code_of(page: Path) -> str:
    """The blocks of a page that are not marked `no-run`, at their lines."""
    text = page.read_text()
    lines = [""] * text.count("\n")
    for block in BLOCK.finditer(text):
        if "no-run" in block[1].split():
            continue
        first = text[: block.start()].count("\n") + 1
        for k, line in enumerate(block[2].splitlines()):
            lines[first + k] = line
    return "\n".join(lines).rstrip()


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if code_of(p).strip()], ids=lambda page: page.name
)
def test_code_in_the_documentation_runs(page, tmp_path):
    if "SEQUENCE_FOLDER" in code_of(page):
        simulated = simulation.simulate(Simulation(length=60))
        simulation.write_sequence(tmp_path / "SEQUENCE_FOLDER", simulated)
    script = tmp_path / f"{page.stem}.py"
    script.write_text(code_of(page))
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-2000:]
    expected = "".join(OUTPUT.findall(page.read_text()))
    last = done.stdout.splitlines()[-len(expected.splitlines()) :]
    assert not expected or same(last, expected.splitlines()), done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_in_the_documentation_is_python(page):
    compile(code_of(page), str(page), "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_files_named_in_the_architecture_exist():
    page = (ROOT / "docs" / "architecture.md").read_text()
    for name in re.findall(r"`(bodyslam_jax/[\w/]+(?:\.py|/)?)`", page):
        assert (ROOT / name).exists(), name


def test_names_that_the_architecture_finds_in_a_file_are_defined_there():
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = re.findall(r"`([\w.]+)` in `(bodyslam_jax/[\w/]+\.py)`", page)
    assert len(named) > 15
    for name, file in named:
        body = ast.parse((ROOT / file).read_text()).body
        for part in name.split("."):
            found = [node for node in body if getattr(node, "name", None) == part]
            assert found, f"{name} in {file}"
            body = getattr(found[0], "body")


REFERENCE = sorted((ROOT / "docs" / "reference").glob("*.md"))
ENTRY = re.compile(r"^::: bodyslam_jax\.([\w.]+)$", re.MULTILINE)


def test_every_public_name_has_an_entry_in_the_reference():
    entries = {
        e.split(".")[-1] for page in REFERENCE for e in ENTRY.findall(page.read_text())
    }
    assert not set(bodyslam_jax.__all__) - entries


@pytest.mark.parametrize("page", REFERENCE, ids=lambda page: page.stem)
def test_entries_of_the_reference_are_documented(page):
    entries = ENTRY.findall(page.read_text())
    assert entries
    for entry in entries:
        home, _, name = f"bodyslam_jax.{entry}".rpartition(".")
        try:
            found = importlib.import_module(f"{home}.{name}")
        except ImportError:
            found = getattr(importlib.import_module(home), name)
        assert inspect.getdoc(found), entry


def test_every_page_is_in_the_navigation():
    listed = set(
        re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    )
    pages = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    assert pages == listed
