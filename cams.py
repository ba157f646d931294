from explore import *
import time
from bodyslam_jax import synthetic
from bodyslam_jax.config import Simulation
from scipy.spatial.transform import Rotation as R


def cam(T, fps):
    x = T[:, :3, 3]
    v = np.linalg.norm(np.diff(x, axis=0), axis=1) * fps
    a = np.linalg.norm(np.diff(x, 2, axis=0), axis=1) * fps**2
    n = max(1, round(0.1 * fps))
    a1 = np.linalg.norm(x[2 * n :] - 2 * x[n:-n] + x[: -2 * n], axis=1) * fps**2 / n**2
    r = R.from_matrix(T[:, :3, :3])
    w = np.degrees((r[:-1].inv() * r[1:]).magnitude()) * fps
    wn = np.degrees((r[:-n].inv() * r[n:]).magnitude()) * fps / n
    return dict(
        v95=np.percentile(v, 95),
        vmax=v.max(),
        a50=np.median(a),
        a95=np.percentile(a, 95),
        amax=a.max(),
        a01max=a1.max(),
        w95=np.percentile(w, 95),
        wmax=w.max(),
        w01max=wn.max(),
    )


if __name__ == "__main__":
    for fam in ("room", "follow"):
        for s in ("E1", "M2", "M4", "D1", "D2", "D3"):
            t0 = time.time()
            m = synthetic.simulate(
                Simulation(sequence=s, family=fam, length=300, seed=7)
            )
            tr = synthetic.as_truth(m)
            f = figs(tr.joints[0], 30)
            print(
                fam,
                s,
                round(time.time() - t0, 1),
                {k: round(float(v), 2) for k, v in cam(tr.T_WC, 30).items()},
                {
                    k: round(float(f.get(k, np.nan)), 2)
                    for k in "skate slope resid lean knee straighter turn0.2 jump0.2 acc".split()
                },
                flush=True,
            )
