"""How bent the knee of a standing leg is in recorded walks, for `people.walking_knees`.

    python tools/walking_knees.py cmu_locomotion.npz

The archive is that of `motion.read_motion`; walks of its training subjects count. A leg
stands by the contact network, as in the fit. Prints each subject, then mean and
standard deviation among subjects, degrees.
"""

import sys

import jax.numpy as jnp
import numpy as np

from bodyslam_jax import motion
from bodyslam_jax.body import load_body_model
from bodyslam_jax.geometry import so3
from bodyslam_jax.people.walking_knees import alone_of, bend_of


def main() -> None:
    body, network = load_body_model(), motion.load_contact_model()
    found: dict[str, list[float]] = {}
    for clip in motion.read_motion(sys.argv[1]):
        if clip.phase or clip.motion != "walk" or clip.split != "train":
            continue
        probability = motion.predict_contact(
            network,
            body,
            so3.exp(jnp.asarray(clip.poses[:, 0])),
            jnp.asarray(clip.poses[:, 1:]),
            jnp.zeros(10, clip.poses.dtype),
            jnp.ones(len(clip.poses), bool),
        )
        alone = alone_of(np.asarray(probability))
        if alone.any(axis=0).all():
            bend = bend_of(clip.poses[:, 1:], alone)
            found.setdefault(clip.subject, []).append(float(np.degrees(bend)))
    means = {subject: np.mean(bends) for subject, bends in found.items()}
    for subject, bend in means.items():
        print(f"{subject}: {bend:.1f}")
    every = np.array(list(means.values()))
    print(f"{len(every)} subjects: {every.mean():.1f} ± {every.std(ddof=1):.1f}")


if __name__ == "__main__":
    main()
