# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A factor of your own
# The joint estimate is a sum of factors: each has measurements, and a residual in
# standard deviations. Here a position sensor is put on the camera, such as a satellite
# receiver with an error of some centimetres, and its weight is looked at. Nothing but
# the public names of `bodyslam_jax` is used. **Everything here is simulated.**

# %%
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float

import bodyslam_jax as bs

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## Measurements, problem, first state
# A walker whom a hand-held camera follows for 40 frames. Cameras and map are held where
# structure from motion left them, in a unit of their own; people and the scale s are
# estimated.

# %%
case = bs.simulate_case("M2", family="follow", frames=40)
problem, state = bs.build(case, hold=("cameras", "landmarks"))
people_only = bs.solve(problem, state)
print(people_only.status)
print(f"s = {float(people_only.state.scale):.3f}, true: {case.map_scale:.3f}")

# %% [markdown]
# ## The factor
# `t` is the axis of frames. The residual of one frame gets that frame's measurements in
# the order in which they are declared, the frame's variables (`window[0]`; the frame
# before would be `window[1]`) and those that all frames share.


# %%
class CameraPosition(bs.FrameFactor):
    """Positions of the camera, m, in the axes of the map."""

    position: Float[Array, "t 3"]
    sigma: Float[Array, " t"]
    keys = (("camera", 0), ("scale", 0))

    def frame_residual(self, data, window, shared):
        position, sigma = data
        return (shared.scale * window[0].camera[:3, 3] - position) / sigma


# %% [markdown]
# Its measurements: true distances along the path that structure from motion found, with
# an error of 5 cm. Every fifth frame has one; the others are missing, `sigma = inf`.

# %%
rng = np.random.default_rng(0)
path = case.map_scale * np.asarray(state.cameras[:, :3, 3])
position = path + 0.05 * rng.standard_normal(path.shape)
sigma = np.where(np.arange(len(path)) % 5 == 0, 0.05, np.inf)
sensor = CameraPosition(jnp.asarray(position), jnp.asarray(sigma))

# %% [markdown]
# `check_factor` refuses in one line what a solver cannot use: variables that `keys`
# leaves out, derivatives that are not finite, code that cannot be traced, shapes that do
# not fit.

# %%
print(bs.check_factor(sensor, state))


class Forgotten(CameraPosition):
    keys = (("camera", 0),)


try:
    bs.check_factor(Forgotten(sensor.position, sensor.sigma), state)
except ValueError as error:
    print(error)

# %% [markdown]
# ## With and without it

# %%
with_sensor = problem.with_factors(sensor)
both = bs.solve(with_sensor, state)
for name, found in (("people only", people_only), ("and sensor", both)):
    ratio = float(found.state.scale) / case.map_scale
    print(f"{name:12} {found.status}, s over the true one: {ratio:.3f}")
for name, cost in with_sensor.cost_by_term(both.state).items():
    print(f"{name:26} {float(cost):9.2f}")

# %% [markdown]
# ## How much is it trusted?
# λ of the new term has a name as all others have. The solution for several of them is one
# solve each, in the program that is compiled already.

# %%
name = "camera_position"
print(f"λ = {float(bs.weights(with_sensor)[name]):.0f} / m²")
factors = np.array([1e-6, 1e-4, 1e-2, 1.0])


def scale_of(weight):
    weighted = bs.with_weights(with_sensor, camera_position=weight)
    return bs.solve(weighted, state).state.scale


scales = np.array([float(scale_of(w)) for w in bs.weights(with_sensor)[name] * factors])
plt.figure(figsize=(5, 3))
plt.semilogx(factors, scales / case.map_scale, "o-", label="people and sensor")
plt.axhline(float(people_only.state.scale) / case.map_scale, ls="--", label="people only")
plt.axhline(1, color="0.5", lw=0.8)
plt.xlabel("factor on the sensor's λ")
plt.ylabel("s over the true one")
_ = plt.legend()
