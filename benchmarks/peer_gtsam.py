"""Cameras and landmarks by GTSAM's Levenberg-Marquardt: a peer of the solver.

    python peer_gtsam.py problem.npz result.npz

Run by `bench_solver.py peers --peer-python PYTHON`, where PYTHON has `gtsam` and NumPy.
Projection factors with a Cauchy loss, intrinsics held. GTSAM has no constant variables,
so priors hold the gauge: one on the first camera, one on its distance from another.
Both are met exactly at the optimum, where they cost nothing.
"""

import importlib.metadata
import sys
import time

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

SECONDS = 240.0
"""It is stopped after so long, or after the steps given."""


def graph_of(data):
    """The problem as a factor graph; a point behind a camera costs a constant there."""
    graph = gtsam.NonlinearFactorGraph()
    fx, fy, cx, cy = data["intrinsics"]
    calibration = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(float(data["loss"])),
        gtsam.noiseModel.Unit.Create(2),
    )
    seen = zip(
        data["pixel"], data["frame"].tolist(), data["landmark"].tolist(), strict=True
    )
    for pixel, k, i in seen:
        graph.add(
            gtsam.GenericProjectionFactorCal3_S2(
                pixel, noise, X(k), L(i), calibration, False, False
            )
        )
    tight = gtsam.noiseModel.Isotropic.Sigma
    first, second = gtsam.Pose3(data["cameras"][0]), far_camera(data)
    away = first.range(gtsam.Pose3(data["cameras"][second]))
    graph.add(gtsam.PriorFactorPose3(X(0), first, tight(6, 1e-4)))
    graph.add(gtsam.RangeFactorPose3(X(0), X(second), away, tight(1, 1e-4)))
    return graph


def far_camera(data):
    """The farthest camera that shares a landmark with the first: no new fill-in."""
    with_first = data["landmark"][data["frame"] == 0]
    near = np.unique(data["frame"][np.isin(data["landmark"], with_first)])
    place = data["cameras"][:, :3, 3]
    return int(near[np.argmax(np.linalg.norm(place[near] - place[0], axis=1))])


def main(source, target):
    with np.load(source) as archive:
        data = dict(archive)
    graph, start = graph_of(data), gtsam.Values()
    for k, T_WC in enumerate(data["cameras"]):
        start.insert(X(k), gtsam.Pose3(T_WC))
    seen = np.unique(data["landmark"])
    for i in seen.tolist():
        start.insert(L(i), data["points"][i])
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    clock = lambda: np.array([time.perf_counter(), time.process_time()])
    rows, spent = [(0.0, graph.error(start))], np.zeros(2)
    before = clock()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
    spent += clock() - before
    capped = False
    while True:
        before = clock()
        optimiser.iterate()
        spent += clock() - before
        rows.append((spent[0], optimiser.error()))
        # Its own `optimize` stops by the same rule.
        if rows[-2][1] - rows[-1][1] <= float(data["rtol"]) * rows[-2][1]:
            break
        capped = len(rows) > data["steps"] or spent[0] > SECONDS
        if capped:
            break
    found = optimiser.values()
    points = data["points"].copy()
    for i in seen.tolist():
        points[i] = found.atPoint3(L(i))
    np.savez(
        target,
        cameras=[found.atPose3(X(k)).matrix() for k in range(len(data["cameras"]))],
        points=points,
        seconds=spent[0],
        processor=spent[1],
        rows=np.array(rows),
        solves=optimiser.iterations(),
        capped=capped,
        versions=f"gtsam {importlib.metadata.version('gtsam')}",
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
