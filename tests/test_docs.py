"""Code in README.md and docs/ runs: blocks of a page in order, in one program."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


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
    script = tmp_path / f"{page.stem}.py"
    script.write_text(code_of(page))
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-2000:]


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
