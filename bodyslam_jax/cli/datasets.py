"""`bodyslam convert-dataset`: sequences of public datasets -> sequence folders."""

from pathlib import Path

import tyro

from bodyslam_jax.cli.options import Input

_Out = tyro.conf.Positional[Path]


def emdb(source: Input, out: _Out, /, *, body_model: Path | None = None) -> None:
    """One sequence of EMDB: camera, images and ground truth.

    Args:
        source: Folder with *_data.pkl and images/.
        out: Sequence folder to write.
        body_model: SMPL of the subject's gender, or a folder with it; it gives the true
            joints. Without it, the search path that `bodyslam doctor` prints.
    """
    from bodyslam_jax import evaluation

    print(evaluation.convert_emdb(source, out, body_model))


def threedpw(source: Input, out: _Out, /) -> None:
    """One sequence of 3DPW: camera, images, keypoints and ground truth.

    Args:
        source: sequenceFiles/SPLIT/NAME.pkl, with imageFiles/ beside sequenceFiles/.
        out: Sequence folder to write.
    """
    from bodyslam_jax import evaluation

    print(evaluation.convert_3dpw(source, out))


def rich(
    root: Input,
    out: _Out,
    /,
    *,
    split: str,
    sequence: str,
    camera: int,
    body_model: Path | None = None,
    genders: Path | None = None,
) -> None:
    """One still camera's view of a RICH sequence: camera, images and ground truth.

    Args:
        root: Folder with bodies/, images/ and scan_calibration/.
        out: Sequence folder to write.
        split: train, val or test.
        sequence: Name of the sequence.
        camera: Number of the camera.
        body_model: Folder with SMPL-X of the subjects' genders; it gives the true
            joints.
        genders: gender.json of RICH's toolkit, if not in its resource/ here.
    """
    from bodyslam_jax import evaluation

    print(
        evaluation.convert_rich(root, split, sequence, camera, out, body_model, genders)
    )


def tum_amass(
    trajectory: Input,
    motion: tyro.conf.Positional[Path],
    out: _Out,
    /,
    *,
    images: Path | None = None,
) -> None:
    """A camera trajectory (TUM) and a motion (AMASS) as one ground truth.

    Args:
        trajectory: TUM file, camera to world, one line per frame.
        motion: AMASS file (.npz).
        out: Sequence folder to write.
        images: Folder of images, if there are any.
    """
    from bodyslam_jax import evaluation

    print(evaluation.convert_tum_amass(trajectory, motion, out, images))
