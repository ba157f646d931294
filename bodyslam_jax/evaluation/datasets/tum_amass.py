"""Combines a camera trajectory and a person's motion of any origin."""

import shutil
from pathlib import Path

from bodyslam_jax.body import DEFAULT, load_body_model
from bodyslam_jax.evaluation.datasets import checks, folder
from bodyslam_jax.evaluation.readers import read_body, read_tum


def convert_tum_amass(
    trajectory: Path, motion: Path, out: Path, images: Path | None = None
) -> Path:
    """Combines a TUM trajectory, an AMASS file, and images if any, in `out`.

    The files are copied as they are; `read_groundtruth` resamples them to a common
    rate.

    **Raises:** as `convert_emdb`.
    """
    read_tum(trajectory)
    if not motion.is_file():
        raise checks.not_there(motion, "AMASS")
    # Checks that the file can be read; the body model is irrelevant for that.
    read_body(motion, load_body_model(DEFAULT))
    if images is not None:
        checks.images(images)
    with folder.sequence_folder(out, "TUM and AMASS", motion) as partial:
        (partial / "groundtruth").mkdir()
        shutil.copyfile(trajectory, partial / "groundtruth" / "camera.txt")
        shutil.copyfile(motion, partial / "groundtruth" / "body.npz")
        if images is not None:
            folder.link_images(partial, images)
    return out
