"""Writes `docs/cli.md` from the command line's own code.

`python tools/make_cli_docs.py`; a test compares the two.
"""

from pathlib import Path

from bodyslam_jax.cli import reference

if __name__ == "__main__":
    (Path(__file__).parents[1] / "docs" / "cli.md").write_text(reference())
