"""`bodyslam body-model`: shows, converts and checks body model files."""

from pathlib import Path
from typing import Literal

import tyro

from bodyslam_jax.cli.options import Input

_Gender = Literal["neutral", "female", "male"]


def body_show(
    file: tyro.conf.Positional[Path | None] = None,
    /,
    *,
    out: Path = Path("body_model.png"),
    gender: _Gender | None = None,
) -> None:
    """Draws a body model: shape components at ±2 σ and a few postures.

    Args:
        file: Body model; without it the one that `bodyslam doctor` names.
        out: Picture to write (.png).
        gender: Gender of the file in a folder. Default: neutral.
    """
    from bodyslam_jax import body

    body.save_picture(body.load_body_model(file, gender), out)
    print(out)


def body_convert(
    file: Input,
    out: tyro.conf.Positional[Path],
    /,
    *,
    gender: _Gender | None = None,
) -> None:
    """Writes a body model in SMPL's own .npz layout, readable without chumpy.

    Args:
        file: Any supported body model file, or a folder of them.
        out: The .npz to write.
        gender: Gender of the file in a folder. Default: neutral.
    """
    from bodyslam_jax import body

    body.write_npz(body.load_body_model(file, gender), out)
    print(out)


def body_check(file: Input, /, *, gender: _Gender | None = None) -> None:
    """Prints the kind of a body model file, or why it cannot be used.

    Args:
        file: Body model file or folder.
        gender: Gender of the file in a folder. Default: neutral.
    """
    from bodyslam_jax import body

    print(body.check(file, gender))
