"""As how many observations a likelihood counts: windows that fit into the training part, or what its scores say.

Each recording is tuned without truth twice: with N windows, and with N from the spread of the scores over blocks of
time (`tuning.evidence.Job.by_scores`) at what the first found.
"""

from benchmarks import common
from benchmarks.recordings.wild import sources
from jaxnav import build, read
from jaxnav.analysis.tables import table
from jaxnav.filters.compiler import make_room
from tuning import Tuned, tune
from tuning.evidence import Job

SOME = ("px4_quad106", "kth", "px4_fixed_wing")


def ratio(found: Tuned) -> float:
    """Drift over the windows of the test against the datasheet's, RMS."""
    return found.test[found.chosen]["rms_m"] / found.test["datasheet"]["rms_m"]


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("tempering", __doc__.splitlines()[0])
    parser.add_argument(
        "--only", metavar="A,B", default=",".join(SOME), help=f"these recordings, default {','.join(SOME)}"
    )
    args = parser.parse_args(argv)
    results = {}
    for name in args.only.split(","):
        make_room()
        rec = read(sources()[name])
        ekf = build("ekf15", measurements=[key for key in ("position", "velocity") if key in rec.aiding], cov_stride=5)
        first = tune(rec, ekf, ekf.params("consumer"))
        # the winner may have a state more than the datasheet
        more = [u._replace(sheet=u.sheet._replace(states=first.params.states | u.sheet.states)) for u in first.used]
        job = Job(first.filter, first.spec, more)
        number = max(1.0, job.by_scores(job.numbers(first.each)))
        second = tune(rec, ekf, ekf.params("consumer"), observations=number)
        results[name] = {
            "windows": first.effective, "scores": number, "ratio_windows": ratio(first), "ratio_scores": ratio(second),
            "chosen": [first.chosen, second.chosen],
        }  # fmt: skip
        print(name, results[name], flush=True)
        common.write_json(args.json, results)
    rows = [[name, r["windows"], r["scores"], r["ratio_windows"], r["ratio_scores"]] for name, r in results.items()]
    print(table(["recording", "N, windows", "N, scores", "ratio", "ratio"], rows))
