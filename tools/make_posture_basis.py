"""Derives the basis in which the solver moves postures (`people.posture_basis`).

    python tools/make_posture_basis.py OUT.npz

A deviation of a posture from a guess has the prior N(0, s² I), s = 0.2 rad a turn (the
default `posture_sigma`). Keypoints of BODY_25, seen from a side drawn at random with an
error of 3 cm, and with the root unknown, leave the covariance (I / s² + J^T J / σ²)^-1.
The basis has the eigenvectors of what keypoints take from the prior, `s² I` less that,
in the mean over postures that are drawn from `posture_prior.npz`: the directions in
which estimates differ from guesses, those first in which they do most.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import load_body_model
from bodyslam_jax.graph.keypoint_jacobian import keypoint_jacobian
from bodyslam_jax.people.posture_prior import load_posture_prior

COUNT = 48
DRAWS = 2000
PRIOR, KEYPOINTS = 0.2, 0.03  # rad, m


def information(points, by_pose, heading):
    """Of keypoints about the turns of joints, from one side; the root is unknown."""
    c, s = np.cos(heading), np.sin(heading)
    image = np.array([[c, 0.0, s], [0.0, 1.0, 0.0]])
    rows = np.einsum("ai,ikm->kam", image, by_pose).reshape(-1, 69)
    turn = np.cross(np.eye(3)[None], points[:, None]).swapaxes(1, 2)
    root = np.concatenate(
        [
            np.einsum("ai,kij->kaj", image, turn).reshape(-1, 3),
            np.tile(image, (len(points), 1)),
        ],
        axis=1,
    )
    known, _ = np.linalg.qr(root)
    rows = rows - known @ (known.T @ rows)
    return rows.T @ rows / KEYPOINTS**2


def main(out: Path) -> None:
    rng = np.random.default_rng(0)
    body = load_body_model(dtype=jnp.float64)
    prior = load_posture_prior(30.0, np.float64)
    latent = rng.standard_normal((DRAWS, prior.basis.shape[1]))
    poses = prior.decode(jnp.asarray(latent))
    of_pose = lambda pose: keypoint_jacobian(body, pose, jnp.zeros(10), "body25", 0.0)
    points, by_pose, _ = map(np.asarray, jax.jit(jax.vmap(of_pose))(poses))
    taken = PRIOR**2 * np.eye(69)
    for p, j in zip(points, by_pose, strict=True):
        known = information(p, j, rng.uniform(0, 2 * np.pi)) + np.eye(69) / PRIOR**2
        taken -= np.linalg.inv(known) / DRAWS
    values, vectors = np.linalg.eigh(taken)
    share = values[::-1] / PRIOR**2
    basis = vectors[:, ::-1][:, :COUNT]
    basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(COUNT)])
    print("share of the prior's variance taken:", share[: COUNT + 8].round(3))
    np.savez(out, basis=basis, share=share[:COUNT], source=np.array(__doc__))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(Path(sys.argv[1]))
