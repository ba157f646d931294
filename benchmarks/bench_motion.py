"""How fast the motion models are, beside the paper's network in PyTorch.

    python benchmarks/bench_motion.py [--peer-python PYTHON] [--rounds N]

Training: samples a second of the paper's network (batch 4096, Adam), of updates on one
batch and of whole epochs in which every batch is drawn and disturbed anew, with the
share of this machine's matrix-product rate, measured in the same process, that the
network's products come to. Prediction and Jacobian of displacement for 1,000 frames: of
the paper's network from its inputs, as PyTorch does it, and of both models from the
postures of their windows, forward kinematics and all. PyTorch is no dependency: name an
interpreter that has it (or set BODYSLAM_PEER_PYTHON). Compilation is outside the clock;
the fastest of several runs counts, since a shared machine only ever adds time.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

BATCH, FRAMES, UPDATES = 4096, 1000, 3
WALKS = Path(__file__).parents[1] / "bodyslam_jax/simulation/assets/walking.npz"
SIZES = ((154, 1024, 1024, 1024), (1024, 1024, 1024, 3), (1024, 1024, 1024, 72))
PRODUCTS = sum(a * b for part in SIZES for a, b in zip(part[:-1], part[1:]))


def clock(call, rounds):
    """Seconds of the fastest of several calls after a first one."""
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def noisy(settings):
    """Errors as in the table's noisy row."""
    return dataclasses.replace(settings, drift_deg=9.0, white_deg=0.5, clean_share=0.3)


def in_jax(rounds):
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import optax

    from bodyslam_jax.body import load_body_model
    from bodyslam_jax.config import MotionTraining
    from bodyslam_jax.motion import (
        MotionModel,
        load_motion_model,
        predict,
        read_motion,
    )
    from bodyslam_jax.motion.paper_network import PaperNetwork
    from bodyslam_jax.motion.training import sampling, train
    from bodyslam_jax.motion.training import train as training

    wait = jax.block_until_ready
    a = jnp.ones((4096, 1024), jnp.float32)
    b = jnp.ones((1024, 1024), jnp.float32)
    gemm = jax.jit(lambda a, b: a @ b)
    gemm_rate = 2 * 4096 * 1024**2 / clock(lambda: wait(gemm(a, b)), 10 * rounds)
    yield "matrix products, GFLOP/s", gemm_rate / 1e9

    settings = MotionTraining.paper()
    body = load_body_model(dtype=jnp.float32)
    data = sampling.corpus(read_motion(WALKS), settings)
    network = training.initial_network(jax.random.key(0), settings)
    assert isinstance(network, PaperNetwork)
    progress = training.start(network, settings)
    share = lambda rate: 6 * PRODUCTS * rate / gemm_rate

    batch = sampling.draw(jax.random.key(1), data, body, settings)
    update = training.optimiser(settings, 1)
    moving, fixed = eqx.partition(network, training.trainable(network))

    @jax.jit
    def step(moving, state):
        gradient = jax.grad(
            lambda m: train.loss(eqx.combine(m, fixed), batch, settings)
        )(moving)
        change, state = update.update(gradient, state, moving)
        return optax.apply_updates(moving, change), state

    seconds = clock(lambda: wait(step(moving, progress.optimiser)), rounds)
    yield "training, samples/s", BATCH / seconds
    yield "training, share of the product rate", share(BATCH / seconds)
    for name, chosen in (("exact", settings), ("noisy", noisy(settings))):
        epoch = lambda: training.run_epoch(progress, data, body, chosen, UPDATES, 100)
        seconds = clock(lambda: wait(epoch()), max(rounds // 3, 1))
        rate = UPDATES * BATCH / seconds
        yield f"whole epoch, {name} postures, samples/s", rate
        yield f"whole epoch, {name} postures, share of the product rate", share(rate)

    rows = jax.random.normal(jax.random.key(2), (FRAMES, SIZES[0][0]), jnp.float32)
    forward = jax.jit(lambda rows: network.normalised(rows))
    seconds = clock(lambda: wait(forward(rows)), rounds)
    yield f"paper's network: prediction of {FRAMES} frames, ms", 1e3 * seconds
    moved = jax.jit(jax.vmap(jax.jacrev(lambda row: network.normalised(row)[:3])))
    seconds = clock(lambda: wait(moved(rows)), max(rounds // 3, 1))
    yield f"paper's network: Jacobian of {FRAMES} frames, ms", 1e3 * seconds

    paper = MotionModel(network, body.kind, 30.0, 2)
    turn = jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (FRAMES, 3, 3))
    pose = 0.1 * jax.random.normal(jax.random.key(1), (FRAMES, 23, 3), jnp.float32)
    shape = jnp.zeros(10, jnp.float32)
    there = jnp.ones(FRAMES, bool)
    for name, model in (("paper", paper), ("default", load_motion_model())):
        run = eqx.filter_jit(predict)
        seconds = clock(
            lambda: wait(run(model, body, turn, pose, shape, there)), rounds
        )
        yield f"{name}, from postures: prediction of {FRAMES} frames, ms", 1e3 * seconds
        past = model.past

        @jax.jit
        def jacobian(pose, model=model, past=past):
            windows = pose[np.arange(FRAMES - past)[:, None] + np.arange(past + 1)]
            one = lambda window: predict(
                model, body, turn[: past + 1], window, shape, there[: past + 1]
            ).translation[-1]
            return jax.lax.map(jax.jacrev(one), windows, batch_size=100)

        seconds = clock(lambda: wait(jacobian(pose)), max(rounds // 3, 1))
        yield f"{name}, from postures: Jacobian of {FRAMES} frames, ms", 1e3 * seconds


def in_torch(rounds):
    import torch
    from torch import nn

    torch.set_num_threads(os.cpu_count() or 1)

    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            stack = lambda sizes, end: nn.Sequential(
                *[
                    layer
                    for i, (a, b) in enumerate(zip(sizes[:-1], sizes[1:]))
                    for layer in (
                        [nn.Linear(a, b)]
                        + ([nn.ReLU()] if i < len(sizes) - 2 or end else [])
                    )
                ]
            )
            self.encoder = stack(SIZES[0], True)
            self.position, self.posture = stack(SIZES[1], False), stack(SIZES[2], False)

        def forward(self, x):
            hidden = self.encoder(x)
            return self.position(hidden), self.posture(hidden) + x[:, 72:144]

    network = Network()
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    x = torch.randn(BATCH, 154)
    goal = torch.randn(BATCH, 3), torch.randn(BATCH, 72)

    def step():
        optimiser.zero_grad()
        move, pose = network(x)
        loss = ((move - goal[0]) ** 2).sum(-1) + ((pose - goal[1]) ** 2).sum(-1) / 24
        loss.mean().backward()
        optimiser.step()

    yield "training, samples/s", BATCH / clock(step, rounds)
    frames = torch.randn(FRAMES, 154)

    def forward():
        with torch.no_grad():
            network(frames)

    yield (
        f"paper's network: prediction of {FRAMES} frames, ms",
        1e3 * clock(forward, rounds),
    )
    one = lambda row: network(row[None])[0][0]
    jacobian = torch.func.vmap(torch.func.jacrev(one))
    yield (
        f"paper's network: Jacobian of {FRAMES} frames, ms",
        1e3 * clock(lambda: jacobian(frames), max(rounds // 3, 1)),
    )


def worker(python, name, rounds):
    """One program in a process of its own; `{}` if it cannot run."""
    command = [python, __file__, "--worker", name, "--rounds", str(rounds)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        told = [line for line in done.stderr.splitlines() if "Error" in line]
        print(f"{name} left out: {(told or ['no message'])[-1]}", file=sys.stderr)
        return {}
    return json.loads(done.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=6)
    peer = os.environ.get("BODYSLAM_PEER_PYTHON")
    parser.add_argument("--peer-python", default=peer)
    parser.add_argument("--worker", choices=["jax", "torch"])
    options = parser.parse_args()
    if options.worker:
        program = in_jax if options.worker == "jax" else in_torch
        print(json.dumps(dict(program(options.rounds))))
        return
    ours = worker(sys.executable, "jax", options.rounds)
    peer = (
        worker(options.peer_python, "torch", options.rounds)
        if options.peer_python
        else {}
    )
    print("| | ours | PyTorch |\n|---|---|---|")
    for name in ours:
        other = f"{peer[name]:,.2f}" if name in peer else ""
        print(f"| {name} | {ours[name]:,.2f} | {other} |")


if __name__ == "__main__":
    main()
