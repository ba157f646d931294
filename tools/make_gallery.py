"""Pictures and errors of rendered sequences for `docs/gallery.md`.

    python tools/make_gallery.py FOLDER E1-room M2-follow D2-room [--frames 120]

Each sequence is rendered and estimated from its images alone, as in `bodyslam
experiment video`. Writes a frame of each overlay to `docs/pictures`, and prints a line
of the page's table for each. Runs stay in FOLDER.
"""

import argparse
from pathlib import Path

import cv2
import jax
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import evaluation, io, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.experiments.video import filmed
from bodyslam_jax.pipeline.run_folder import run_to_folder

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
WIDTH = 900
"""Of a picture, px."""


def read_frame(video: Path, share: float) -> np.ndarray:
    """The frame of a video after this share of its frames."""
    capture = cv2.VideoCapture(str(video))
    images = []
    while (found := capture.read())[0]:
        images.append(found[1])
    capture.release()
    return images[round(share * (len(images) - 1))]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="+", help="such as E1-room")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--share", type=float, default=0.6, help="of the video")
    options = parser.parse_args()
    PICTURES.mkdir(exist_ok=True)
    body = bs.load_body_model()
    for name in options.names:
        sequence, family = name.split("-")
        plain = Simulation(sequence=sequence, family=family, length=options.frames)  # pyright: ignore[reportArgumentType]
        simulated = simulation.simulate(filmed(plain), body)
        film = simulation.film_scene(options.folder / f"{name}-film", simulated)
        out = options.folder / name
        config = Config().for_simulated_people()
        result = run_to_folder(io.read_sequence(film), out, config)
        pair = evaluation.associate(result, simulation.as_truth(simulated), body)
        errors = {k: float(v) for k, v in evaluation.evaluate(*pair).items()}
        picture = read_frame(out / "overlay.webm", options.share)
        height = round(picture.shape[0] * WIDTH / picture.shape[1])
        picture = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
        jpeg = [cv2.IMWRITE_JPEG_QUALITY, 80]
        cv2.imwrite(str(PICTURES / f"{name}.jpg"), picture, jpeg)
        knee = np.degrees(errors["straighter_knee"])
        true_knee = np.degrees(errors["straighter_knee_of_truth"])
        print(
            f"| {name} | {errors['scale']:.3f} | {1e3 * errors['h_ate_sim3']:.0f} "
            f"| {1e3 * errors['pa_mpjpe']:.0f} | {errors['foot_speed']:.2f} "
            f"({errors['foot_speed_of_truth']:.2f}) | {knee:.0f} ({true_knee:.0f}) "
            f"| {np.degrees(errors['gravity_error']):.1f} "
            f"| {result.summary['status']} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
