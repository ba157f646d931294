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
# # The body
# A body model turns 72 numbers of posture, 10 of shape and 3 of place into joints,
# keypoints and skin, all in metres. The package ships one that is free to use; files of
# SMPL, SMPL-H and SMPL-X load the same way.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import body

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70
model = bs.load_body_model()
print(model.name, model.num_vertices, "vertices,", len(model.faces), "faces")

# %% [markdown]
# ## Shape
# β = 0 is an adult of 1.69 m. β_0 is size: one unit is one standard deviation, 10 cm.


# %%
def draw(axis, points, at=0.0, side=False):
    body.draw_body(axis, np.asarray(points), np.asarray(model.faces), side, (at, 0.0))


def finish(axis):
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.set_axis_off()


figure, axis = plt.subplots(figsize=(10, 4))
still = body.posture("arms down", model.dtype)
for i, (k, amount) in enumerate([(0, -2), (0, 2), (1, -2), (1, 2), (2, -2), (2, 2)]):
    shape = jnp.zeros(10).at[k].set(amount)
    draw(axis, body.vertices(model, still, shape, jnp.zeros(3)), 1.1 * i)
    axis.text(1.1 * i, 0.9, f"β{k} = {amount:+d}", ha="center")
finish(axis)

# %%
rest = body.rest_joints(model, jnp.zeros((2, 10)).at[1, 0].set(1.0))
leg = jnp.linalg.norm(rest[:, 4] - rest[:, 1], axis=-1) + jnp.linalg.norm(
    rest[:, 7] - rest[:, 4], axis=-1
)
print("hip to ankle: {:.3f} m; with β0 = 1: {:.3f} m".format(*leg))

# %% [markdown]
# ## Posture and keypoints
# `joints` needs no skin: rest joints are linear in β, and forward kinematics does the
# rest. `keypoints` adds the few vertices that detectors look at (nose, eyes, ears, feet).

# %%
pose = body.posture("step", model.dtype)
shape, trans = jnp.zeros(10), jnp.zeros(3)
points = body.keypoints(model, pose, shape, trans, "body25")
joints = body.joints(model, pose, shape, trans)
skin = body.vertices(model, pose, shape, trans)

figure, axes = plt.subplots(1, 2, figsize=(7, 5))
for axis, (u, sign) in zip(axes, [(0, 1), (2, -1)]):
    draw(axis, skin, side=u == 2)
    axis.plot(sign * joints[:, u], joints[:, 1], "r.", label="joints", ms=8)
    axis.plot(sign * points[:, u], points[:, 1], "b+", label="BODY_25")
    finish(axis)
axes[0].legend(loc="lower left")
for name, point in list(zip(body.KEYPOINT_NAMES["body25"], np.asarray(points)))[:5]:
    print(f"{name:15s}", point.round(3))

# %% [markdown]
# ## Derivatives
# All of it is differentiable, also at the zero pose and at a half turn. How does the left
# ankle move when the left hip turns, and when the person grows?

# %%
ankle = body.JOINT_NAMES.index("left_ankle")
by_pose, by_shape = jax.jacobian(
    lambda pose, shape: body.joints(model, pose, shape, trans)[ankle], (0, 1)
)(pose, shape)
hip = 3 * body.JOINT_NAMES.index("left_hip")
print("d ankle / d hip rotation, m/rad:\n", by_pose[:, hip : hip + 3].round(3))
print("d ankle / d β0, m:", by_shape[:, 0].round(3))
finite = all(
    bool(jnp.isfinite(jax.jacobian(body.joints, 1)(model, p, shape, trans)).all())
    for p in (jnp.zeros(72), jnp.full(72, jnp.pi / jnp.sqrt(3.0)))
)
print("finite at the zero pose and at half turns:", finite)

# %% [markdown]
# ## Fitting by the derivative
# Thirteen keypoints in 3D of somebody else, and a few dozen damped Gauss-Newton steps
# with a weak pull towards rest, give posture and size back.

# %%
used = jnp.array([1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14])
true_pose = body.posture("sitting", model.dtype)
true_shape = jnp.zeros(10).at[0].set(1.5)
target = body.keypoints(model, true_pose, true_shape, trans)[used]


def residual(x):
    found = body.keypoints(model, x[:72], x[72:], trans)[used]
    return jnp.concatenate([(found - target).ravel() / 0.005, 0.3 * x])


@jax.jit
def step(x, damping):
    r, J = residual(x), jax.jacfwd(residual)(x)
    return x - jnp.linalg.solve(J.T @ J + damping * jnp.eye(82), J.T @ r)


x = jnp.zeros(82)
for k in range(40):
    x = step(x, 1e4 * 0.6**k)
error = body.keypoints(model, x[:72], x[72:], trans)[used] - target
print("largest distance left: {:.1f} mm".format(1000 * float(abs(error).max())))
print("β0: {:.2f} (true 1.50)".format(float(x[72])))

figure, axis = plt.subplots(figsize=(6, 4))
found = body.vertices(model, x[:72], x[72:], trans)
wanted = body.vertices(model, true_pose, true_shape, trans)
for i, (points, title) in enumerate([(wanted, "true"), (found, "found")]):
    for j, side in enumerate((False, True)):
        draw(axis, points, 1.1 * (2 * i + j), side)
    axis.text(1.1 * (2 * i) + 0.5, 0.85, title, ha="center")
finish(axis)
