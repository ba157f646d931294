"""`bodyslam body-model`: shows, converts and checks body model files."""

from pathlib import Path

import tyro

from bodyslam_jax.cli._types import Input


def body_show(
    file: tyro.conf.Positional[Path | None] = None,
    /,
    *,
    out: Path = Path("body_model.png"),
) -> None:
    """Draws a body model: shape components at ±2σ and a few postures.

    Args:
        file: Body model; without it the default one.
        out: Picture to write.
    """
    from bodyslam_jax import body

    body.save_picture(body.load_body_model(file), out)
    print(out)


def body_convert(file: Input, out: tyro.conf.Positional[Path], /) -> None:
    """Writes a body model in SMPL's own .npz layout, readable without chumpy.

    Args:
        file: Any supported body model file.
        out: The .npz to write.
    """
    from bodyslam_jax import body

    body.write_npz(body.load_body_model(file), out)
    print(out)


def body_check(file: Input, /) -> None:
    """Says what a body model file is, or why it is not usable.

    Args:
        file: Body model file or folder.
    """
    from bodyslam_jax import body

    print(body.check(file))


ACTIONS = {"show": body_show, "convert": body_convert, "check": body_check}
