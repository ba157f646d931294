"""Writes one table, plots and a page for all run folders in a folder (`collect`)."""

import logging
from pathlib import Path

from bodyslam_jax.batch import plots, rows, table
from bodyslam_jax.batch.index_page import write_index
from bodyslam_jax.batch.inputs import RUNS_FOLDER
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.error_line import error_line

log = logging.getLogger(__name__)
_WRITTEN_FILES = ("table.csv", "table.md", "table.tex", "plots.png", "index.html")


def collect(folder: str | Path) -> list[Path]:
    """Writes `table.csv`, `.md` and `.tex`, `plots.png` and `index.html` into a folder
    of run folders, and returns their paths.

    Clips that failed or have not been run are listed with the reason. A record that
    cannot be read is left out, with a warning that names it.

    **Raises:** `InputError` if there are no run folders, or a folder has the name of a
    file to be written.
    """
    folder = Path(folder)
    for name in _WRITTEN_FILES:
        if (folder / name).is_dir():
            raise InputError(
                f"{folder / name}: a folder of the name of a file that is written; "
                f"move run folders into {folder / RUNS_FOLDER}."
            )
    found = rows.read_rows(folder)
    columns = table.present(rows.columns(), found)
    written = write_tables(folder, columns, found)
    plots.draw(folder / "plots.png", found, columns)
    write_index(folder, found, columns, _thumbnails(folder, found))
    return [*written, folder / "plots.png", folder / "index.html"]


def write_tables(
    folder: Path, columns: list[table.Column], found: list[table.Row]
) -> list[Path]:
    """Writes a table in three formats, and returns their paths."""
    forms = {
        "csv": table.to_csv,
        "md": table.to_markdown,
        "tex": table.to_latex,
    }
    for suffix, form in forms.items():
        atomic.write_text(folder / f"table.{suffix}", form(columns, found))
    return [folder / f"table.{suffix}" for suffix in forms]


def _thumbnails(folder: Path, found: list[table.Row]) -> dict[str, str]:
    """Writes still images of the overlays, and returns their paths by the clip's
    name."""
    from bodyslam_jax.view.video_file import write_thumbnail

    made = {}
    for row in found:
        name = str(row["name"])
        film = folder / str(row["folder"]) / "overlay.webm"
        if not film.is_file():
            continue
        try:
            (folder / "thumbnails").mkdir(exist_ok=True)
            if write_thumbnail(film, folder / "thumbnails" / f"{name}.jpg"):
                made[name] = f"thumbnails/{name}.jpg"
        except Exception as error:  # the page does not depend on this picture
            log.warning("%s: no picture of it (%s).", film, error_line(error))
    return made
