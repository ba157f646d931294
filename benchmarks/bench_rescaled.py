"""Scale times factor, from maps whose unit is 0.1 to 5 times the one it was.

    python benchmarks/bench_rescaled.py [E1-follow M2-room ...] [--frames 40 60 300]
        [--hold cameras landmarks | --hold]

A problem and its state are put into another unit of the map (`bs.rescaled`), so that
the scale is wrong by that factor (section 4.2 of the paper), and solved: scale times
factor is one number where the cost has one minimum. Printed is the largest difference
between the answers, relative to that at 1.
"""

import argparse

import jax
import numpy as np

import bodyslam_jax as bs

FACTORS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=["E1-follow", "M2-room"])
    parser.add_argument("--frames", type=int, nargs="*", default=[40, 60, 300])
    parser.add_argument("--hold", nargs="*", default=["cameras", "landmarks"])
    options = parser.parse_args()
    for name in options.names:
        sequence, family = name.split("-")
        for frames in options.frames:
            case = bs.simulate_case(sequence, family=family, frames=frames)
            problem, state = bs.build(case, hold=tuple(options.hold))
            found = [bs.solve(*bs.rescaled(problem, state, f)) for f in FACTORS]
            answers = [float(x.state.scale) * f for x, f in zip(found, FACTORS)]
            apart = np.ptp(answers) / answers[FACTORS.index(1.0)]
            status = ", ".join(sorted({str(x.status) for x in found}))
            held = " ".join(options.hold) or "nothing"
            line = f"{name} {frames} frames, held {held}: {answers[3]:.9g}"
            print(f"{line}, largest difference {apart:.1e}; {status}", flush=True)


if __name__ == "__main__":
    main()
