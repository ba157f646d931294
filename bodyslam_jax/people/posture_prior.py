"""What postures people take and how fast they change them: a Gaussian process.

A posture θ (21 joints; hands stay at rest) is `mean + basis @ z`. The latent z has
independent components of unit variance, each a second-order autoregression in time:
`z_k = a1 z_{k-1} + a2 z_{k-2} + e`. Such a prior counts a posture that is held for a
second once, not thirty times, and it does not pull a swinging leg towards the mean as
repeated static priors do, nor towards rest as a penalty on velocity does. Beyond the
Gaussian, each angle has limits: a knee does not bend forwards.

Learnt by `tools/make_posture_prior.py` from CMU motion capture; `assets/README.md`.
"""

import functools
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.io.archive import read_npz

ASSET = Path(__file__).parent / "assets" / "posture_prior.npz"
BASIS = ASSET.with_name("posture_basis.npz")
NUM_HANDS = 2
_TRAINED_AT = 30.0
"""Frame rate of the stored autoregression, 1/s (`tools/make_posture_prior.py`)."""


class PosturePrior(eqx.Module):
    """`k` components of posture, at one frame rate."""

    mean: Float[Array, " 63"]
    """θ of joints 1 to 21, rad."""
    basis: Float[Array, "63 k"]
    """rad per standard deviation of each component."""
    lower: Float[Array, " 63"]
    upper: Float[Array, " 63"]
    """Limits of θ, rad."""
    autoregression: Float[Array, "k 2"]
    """`a1, a2` of each component, per frame."""

    def angles(self, latent: Float[Array, "*b k"]) -> Float[Array, "*b 63"]:
        """θ of joints 1 to 21."""
        return self.mean + latent @ self.basis.T

    def decode(self, latent: Float[Array, "*b k"]) -> Float[Array, "*b 23 3"]:
        """Body pose θ, axis-angle."""
        angles = self.angles(latent).reshape(*latent.shape[:-1], 21, 3)
        rest = jnp.zeros((*latent.shape[:-1], NUM_HANDS, 3), latent.dtype)
        return jnp.concatenate([angles, rest], axis=-2)


def load_posture_prior(
    fps: float, dtype: np.dtype | type | None = None
) -> PosturePrior:
    """Returns the prior that ships with the package, for frames `1/fps` apart.

    An autoregression is a sampled damped oscillator: its poles at another rate are
    powers of its poles at 30 fps.
    """
    stored = _read()
    polynomial = [np.array([1.0, -a1, -a2]) for a1, a2 in stored["autoregression"]]
    poles = np.array([np.roots(p) for p in polynomial]).astype(complex)
    poles = poles ** (_TRAINED_AT / fps)
    moved = np.real(np.stack([poles.sum(1), -poles.prod(1)], axis=1))
    dtype = np.dtype(dtype) if dtype else jnp.zeros(0).dtype
    fields = {name: stored[name] for name in _NAMES if name != "autoregression"}
    fields["autoregression"] = moved
    return PosturePrior(**{k: jnp.asarray(v, dtype) for k, v in fields.items()})


@functools.cache
def _read() -> dict[str, np.ndarray]:
    archive = read_npz(ASSET)
    return {name: archive.array(name) for name in _NAMES}


_NAMES = ("mean", "basis", "lower", "upper", "autoregression")


# The 40 directions that keypoints determine span 97 % of the distance (see below).
def posture_basis(count: int = 40) -> Float[np.ndarray, "69 k"]:
    """Returns the directions of the joints' rotations along which estimates of postures
    differ from initial guesses, in decreasing order of that difference: orthonormal
    columns, the `basis` of a problem.

    Derived by `tools/make_posture_basis.py` from the information of keypoints of
    BODY_25. The first 40 are those that keypoints determine: on simulated sequences
    they span 97 % of the distance between guessed and estimated joints, 32 of them
    85 %.

    **Raises:** `ValueError` if `count` is not between 1 and the 48 that there are.
    """
    basis = _stored_basis()
    if not 1 <= count <= basis.shape[1]:
        raise ValueError(
            f"count: {count}, expected a number from 1 to {basis.shape[1]}."
        )
    return basis[:, :count]


@functools.cache
def _stored_basis() -> Float[np.ndarray, "69 48"]:
    return read_npz(BASIS).array("basis")
