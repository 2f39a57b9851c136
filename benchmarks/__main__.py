"""``python -m benchmarks NAME [options]``: every published figure of the project comes from one of these."""

import gc
import importlib
import sys

FOLDERS = {
    "papers": {
        "fwekf": "the FWEKF paper's launch: its figures, twelve cases by a dozen methods, rules tuned by gradient",
        "gipkf": "the GIP-KF paper: outages of 10, 11 and 22 s, against Kalman filters of 9 and 15 states",
        "gpid": "the GPID paper: its tables, figures and claim, against robust and tuned filters",
        "bakeoff": "filters tuned alike on the three papers' scenarios, ranked on runs and types that none has seen",
    },
    "speed": {
        "first": "the first answer: seconds of whole commands, from an empty cache and from a full one",
        "float32": "a batch in float32 against float64: errors over ten minutes",
        "parallel": "covariances of a run as an associative scan against the sequential one",
        "speed": "speed against a C++ floor, plain JAX, numpy and other packages; gradients, compilation, growth",
    },
    "recordings": {
        "navego": "NaveGo's synthetic data against the figures of an independent filter",
        "drive": "a real drive: hidden GNSS windows, datasheet against tuned, held out",
        "check": "findings on recordings, damaged in one way each and as they are",
        "start": "starts in motion: attitude, its sd and the delay of the fixes, simulated and recorded",
        "across": "several drives tuned together, judged on another IMU of the kind",
        "wild": "recordings as their users have them, from file to solution",
        "solve": "every recording by one command: verdict, drift, calibration, time",
        "tight": "tight coupling in Tokyo: windows with a few satellites, against loose coupling",
        "sensors": "barometer, compass, wheels, airspeed: drift of recordings with them and without",
        "peers": "KF-GINS, python-ins and filterpy: the same samples, noise, hidden windows and scores",
        "kitti": "a drive against GTSAM: the same hidden windows, the same sigmas",
        "stream": "the filter sample by sample: against the batch, with late fixes, across a restart; time of a sample",
        "umn": "a fixed-wing flight from an unknown heading, against the onboard filter",
    },
    "simulated": {
        "recover": "noise parameters back from innovations alone, started 10 times off",
        "states": "optional error states: consistent with them, not without",
        "consistency": "NEES and NIS of matched simulations: late and precise fixes, large attitude errors",
        "earth": "stated sd against the truth: white and slow errors of receivers on ten vehicles",
        "verdict": "the verdict of solve on healthy drives and on ones with a fault, against the truth",
        "pauses": "heading behind a pause of the log: error and stated sd",
        "parked": "heading of vehicles that are parked first or stop in between: error and stated sd",
        "damage": "thousands of damaged recordings, settings and checkpoints, and signals: outcomes",
        "faults": "faults of a receiver, twenty-five kinds: rules against a filter with the known time",
        "learned": "networks inside of the filter: noise of fixes, constraints of wheels, against what is made by hand",
        "integrated": "a receiver that integrates its velocity: tuning against the filter with the true numbers",
        "smooth": "the smoother in outages, simulated and of a drive: consistent, and how near inside of them",
    },
}
HOME = {name: folder for folder, names in FOLDERS.items() for name in names}


def main(argv: list[str]) -> int:
    """Run one benchmark; a wrong name lists them all."""
    if not argv or argv[0] not in HOME:
        print("usage: python -m benchmarks NAME [--json F] [options]\n", file=sys.stderr)
        for folder, names in FOLDERS.items():
            print(f"{folder}:", file=sys.stderr)
            for name, help in names.items():
                print(f"  {name:10} {help}", file=sys.stderr)
        return 2
    from jaxnav.app.cli import COLLECT
    from jaxnav.filters.compiler import enable_x64, fast_compiler
    from jaxnav.types import DataError

    fast_compiler()
    enable_x64()
    gc.set_threshold(COLLECT)
    try:
        return importlib.import_module(f"benchmarks.{HOME[argv[0]]}.{argv[0]}").main(argv[1:]) or 0
    except DataError as error:
        print(f"benchmarks {argv[0]}: {error}", file=sys.stderr)
        return 3


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
