"""The images of a simulated sequence."""

import functools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.simulation.figure import dress
from bodyslam_jax.simulation.renderer import Renderer
from bodyslam_jax.simulation.sequences import SimulatedSequence
from bodyslam_jax.simulation.shutter import Shutter, around


def render(simulated: SimulatedSequence) -> Iterator[UInt8[np.ndarray, "rows cols 3"]]:
    """The frames (BGR) of a simulated sequence, one after the other."""
    for image, _ in render_people(simulated):
        yield image


def render_people(
    simulated: SimulatedSequence,
) -> Iterator[tuple[UInt8[np.ndarray, "rows cols 3"], Int[np.ndarray, "rows cols"]]]:
    """The frames (BGR), and the person at each pixel: 0 for none, h + 1 for h."""
    rng = np.random.default_rng([simulated.seed, 1])
    actors = simulated.actors
    figures = [
        dress(a.person, one)
        for a, one in zip(actors, rng.spawn(len(actors)), strict=True)
    ]
    renderer = Renderer(
        simulated.room, figures, simulated.intrinsics, simulated.size, rng,
        Shutter(simulated.settings.exposure, simulated.settings.readout),
    )  # fmt: skip
    posed = [
        f.person.joints(a.walk.poses, a.walk.pelvis)
        for f, a in zip(figures, actors, strict=True)
    ]
    last = simulated.num_frames - 1

    @functools.lru_cache(maxsize=4)
    def skins(k: int) -> list[Float[np.ndarray, "v 3"]]:
        return [
            f.person.vertices(G[k], x[k])
            for f, (G, x) in zip(figures, posed, strict=True)
        ]

    for k in range(last + 1):
        window = [skins(i) for i in range(max(k - 1, 0), min(k + 1, last) + 1)]
        moving = [around(np.stack(one), min(k, 1)) for one in zip(*window, strict=True)]
        yield renderer.frame(simulated.T_WC, k, moving)
