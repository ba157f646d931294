"""Cameras and landmarks by Ceres with COLMAP's cost functions: a peer of the solver.

    python peer_ceres.py problem.npz result.npz

Run by `bench_solver.py peers --peer-python PYTHON`, where PYTHON has `pyceres`,
`pycolmap` and NumPy. SPARSE_SCHUR, 2 threads, Cauchy, intrinsics held; the gauge as
COLMAP holds it by default (one camera, and one coordinate of a second).
"""

import sys
import time

import numpy as np
import pyceres
import pycolmap


def reconstruction(data):
    """The problem as a COLMAP model; cameras in its convention, world to camera."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1280, height=720, params=data["intrinsics"]
    )
    model.add_camera_with_trivial_rig(camera)
    frame, landmark = data["frame"], data["landmark"]
    tracks = [pycolmap.Track() for _ in data["points"]]
    for k, T_WC in enumerate(data["cameras"]):
        rows = np.flatnonzero(frame == k)
        image = pycolmap.Image(name=f"{k:06d}", camera_id=1, image_id=k + 1)
        image.points2D = [pycolmap.Point2D(data["pixel"][row]) for row in rows]
        R = T_WC[:3, :3].T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ T_WC[:3, 3])
        model.add_image_with_trivial_frame(image, pose)
        for i, row in enumerate(rows):
            tracks[landmark[row]].add_element(k + 1, i)
    ids = []
    for point, track in zip(data["points"], tracks, strict=True):
        ids.append(model.add_point3D(point, track, np.zeros(3, np.uint8)))
    return model, ids


class Watch(pyceres.IterationCallback):
    """Cost and seconds after each iteration."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def __call__(self, summary):
        self.rows.append((summary.cumulative_time_in_seconds, summary.cost))
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def main(source, target):
    with np.load(source) as archive:
        data = dict(archive)
    model, ids = reconstruction(data)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.print_summary = False
    ceres = options.ceres
    ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    ceres.loss_function_scale = float(data["loss"])
    ceres.auto_select_solver_type = False
    config = pycolmap.BundleAdjustmentConfig()
    for k in range(len(data["cameras"])):
        config.add_image(k + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    settings = pyceres.SolverOptions()
    settings.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    settings.num_threads = 2
    settings.max_num_iterations = int(data["steps"])
    settings.function_tolerance = float(data["rtol"])
    settings.gradient_tolerance = settings.parameter_tolerance = 0.0
    watch = Watch()
    settings.callbacks = [watch]
    summary = pyceres.SolverSummary()
    wall, processor = time.perf_counter(), time.process_time()
    pyceres.solve(settings, adjuster.problem, summary)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    cameras = np.tile(np.eye(4), (len(data["cameras"]), 1, 1))
    # Each access copies all of them.
    images, points = model.images, model.points3D
    for k in range(len(cameras)):
        pose = images[k + 1].cam_from_world()
        R = pose.rotation.matrix()
        cameras[k, :3, :3], cameras[k, :3, 3] = R.T, -R.T @ pose.translation
    np.savez(
        target,
        cameras=cameras,
        points=np.array([points[i].xyz for i in ids]),
        seconds=wall,
        processor=processor,
        rows=np.array(watch.rows),
        solves=summary.num_linear_solves,
        versions=f"pycolmap {pycolmap.__version__}, pyceres 2.6",
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
