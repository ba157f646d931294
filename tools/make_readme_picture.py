"""The picture in the README: a frame of a demo's overlay, and its paths from above.

    bodyslam demo --out demo && python tools/make_readme_picture.py demo

writes `notebooks/demo.jpg`. Everything in it is simulated.
"""

import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from bodyslam_jax import evaluation, load_body_model

OUT = Path(__file__).parent.parent / "notebooks" / "demo.jpg"


def frame_of(video: Path, share: float) -> np.ndarray:
    """The frame at a share of the video's length, RGB."""
    capture = cv2.VideoCapture(str(video))
    frames = []
    while True:
        there, image = capture.read()
        if not there:
            break
        frames.append(image)
    return frames[int(share * (len(frames) - 1))][..., ::-1]


def main(folder: Path) -> None:
    body = load_body_model()
    result = evaluation.read_result(folder)
    truth = evaluation.read_groundtruth(folder / "scene" / "groundtruth", body)
    own, true = result.T_WC[:, :3, 3], truth.T_WC[:, :3, 3]
    person = np.where(result.present[0, :, None], result.joints[0, :, 0], np.nan)
    place = evaluation.umeyama(jnp.asarray(true), jnp.asarray(own)).apply
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 4.2), width_ratios=(1.45, 1), layout="constrained"
    )
    left.imshow(frame_of(folder / "overlay.webm", 0.5))
    left.set_axis_off()
    points = np.asarray(place(jnp.asarray(result.landmarks)))
    right.scatter(points[:, 0], points[:, 2], s=1, color="0.75", label="landmarks")
    for path, colour, name in (
        (true, "tab:blue", "camera"),
        (np.asarray(truth.joints)[0, :, 0], "tab:orange", "person"),
    ):
        right.plot(path[:, 0], path[:, 2], ":", color=colour, label=f"{name}, true")
    for path, colour, name in (
        (own, "tab:blue", "camera"),
        (person, "tab:orange", "person"),
    ):
        path = np.asarray(place(jnp.asarray(path)))
        right.plot(path[:, 0], path[:, 2], color=colour, label=name)
    both = np.concatenate([true, np.asarray(truth.joints)[0, :, 0]])
    low, high = both.min(0) - 0.7, both.max(0) + 0.7
    right.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), aspect="equal")
    right.set(xlabel="x, m", ylabel="z, m", title="from above, simulated")
    right.legend(fontsize=7)
    figure.savefig(OUT, dpi=80, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
