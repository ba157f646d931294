"""What the package declares: what it imports, bounds, notices, stable names."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

import bodyslam_jax as bs

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "bodyslam_jax"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DISTRIBUTION = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "pxr": "usd-core",
    "rerun": "rerun-sdk",
    "yaml": "pyyaml",
}
"""Of modules that are called otherwise than what is installed."""


def _imported(module: Path) -> set[str]:
    """Names of all modules that a module imports."""
    found = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module)
    return found


@pytest.fixture(scope="module")
def imported() -> set[str]:
    """Names of all modules that the package imports."""
    return {name for m in PACKAGE.rglob("*.py") for name in _imported(m)}


def _name(requirement: str) -> str:
    return re.split(r"[<>=\[ ;]", requirement)[0].lower()


def test_every_import_is_declared(imported):
    extras = PROJECT["optional-dependencies"]
    groups = [extras[name] for name in ("usd", "rerun", "video", "ray", "slurm")]
    declared = {_name(r) for r in sum(groups, PROJECT["dependencies"])}
    tops = {name.split(".")[0] for name in imported} - set(sys.stdlib_module_names)
    needed = {DISTRIBUTION.get(t, t).lower() for t in tops - {"bodyslam_jax"}}
    assert needed <= declared, needed - declared


def test_what_is_used_by_private_names_has_an_upper_bound(imported):
    private = {n.split(".")[0] for n in imported if re.search(r"\._[a-z]", n)}
    private -= {"bodyslam_jax"}
    assert private == {"jax"}
    for name in private:
        (requirement,) = (r for r in PROJECT["dependencies"] if _name(r) == name)
        assert "<" in requirement


def test_the_notice_names_what_the_assets_are_made_of():
    """Of each folder whose model card names a source that must be named."""
    notice = (ROOT / "NOTICE").read_text()
    cards = [p for p in PACKAGE.rglob("assets/README.md") if "CMU" in p.read_text()]
    assert len(cards) == 3
    for card in cards:
        assert str(card.parent.relative_to(ROOT)) in notice
    assert "NSF EIA-0196217" in notice and "mocap.cs.cmu.edu" in notice
    assert "CC0 1.0" in notice and "MakeHuman" in notice and "NAVER" in notice


def test_the_licence_is_declared_once():
    """By its name: PyPI refuses a classifier of a licence beside it."""
    assert PROJECT["license"] == "Apache-2.0"
    assert not [c for c in PROJECT["classifiers"] if c.startswith("License")]
    assert set(PROJECT["license-files"]) == {"LICENSE", "NOTICE"}


def test_the_page_of_stable_names_has_all_and_only_those_that_are_public():
    page = (ROOT / "docs" / "stable.md").read_text()
    (names,) = re.findall(r"```text\n(.*?)```", page, re.DOTALL)
    assert sorted(names.split()) == sorted(bs.__all__)


@pytest.mark.parametrize("minor", ["3.11", "3.12", "3.13"])
def test_versions_of_python_are_declared(minor):
    assert f"Programming Language :: Python :: {minor}" in PROJECT["classifiers"]
