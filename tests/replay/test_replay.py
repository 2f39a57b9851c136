"""Solutions of six recordings as they were: what a change moves, it moves on purpose.

`python -m tests.replay.test_replay` writes them anew; read the difference before you commit it.
"""

import json
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.recordings.wild import sources
from jaxnav import Recording, build, navigate, read
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import simulate_jit, to_recording

KEPT = Path(__file__).with_name("solutions.json")
SECONDS, POINTS = 40.0, 5
SIMULATED = {"urban_short": "ekf15", "gipkf_urban": "ekf15_receiver"}
RECORDED = {"kitti": "ekf15", "umn": "ekf15", "px4_fixed_wing": "ekf15", "comma2k19": "ekf15"}
# what rounding on other processors may do: m, m/s, deg; and of each standard deviation
FAR, CLOSE = {"enu_m": 2e-3, "vel_mps": 1e-3, "rph_deg": 1e-2}, 1e-3


def simulated(name: str) -> Recording:
    what = SCENARIOS[name]
    return to_recording(simulate_jit(jax.random.key(2), what), what)


def solution(name: str) -> dict:
    """Some epochs of the first seconds of a recording's solution."""
    rec = simulated(name) if name in SIMULATED else read(sources()[name])
    filt = build((SIMULATED | RECORDED)[name], [m for m in ("position", "velocity") if m in rec.aiding], cov_stride=5)
    first = navigate(rec, filt, filt.params("consumer"), stop=float(rec.aiding["position"].t[0]) + 75.0 + SECONDS)
    at = np.linspace(0, first.t.size - 1, POINTS).astype(int)
    enu = earth.enu_path(first.lla, rec.aiding["position"].value[0])
    kept = lambda a: np.round(a[at], 7).tolist()
    return {
        "epochs": int(first.t.size), "used": int(first.used[:, 0].sum()), "t_s": kept(first.t), "enu_m": kept(enu),
        "vel_mps": kept(first.vel), "rph_deg": kept(first.rph / DEG), "sd": kept(first.sd),
    }  # fmt: skip


def moved(old: dict, new: dict) -> list[str]:
    """Which numbers differ, in words."""
    lines = [f"{key}: {old[key]} is now {new[key]}" for key in ("epochs", "used") if old[key] != new[key]]
    if lines:
        return lines
    for key in ("enu_m", "vel_mps", "rph_deg", "sd"):
        a, b = np.array(old[key]), np.array(new[key])
        off = np.abs(b - a)
        if key == "rph_deg":
            off = np.minimum(off, 360.0 - off)
        for row, column in np.argwhere(off > (FAR[key] if key in FAR else CLOSE * np.abs(a))):
            was, now, when = a[row, column], b[row, column], old["t_s"][row]
            lines.append(f"{key}[{column}] at {when:.2f} s: {was:.6g} is now {now:.6g}")
    return lines


@pytest.mark.full
@pytest.mark.parametrize("name", SIMULATED | RECORDED)
def test_a_solution_is_as_it_was(name, request):
    if name in RECORDED:
        request.getfixturevalue("data_dir")
    assert moved(json.loads(KEPT.read_text())[name], solution(name)) == []


def test_a_moved_solution_is_named():
    kept = json.loads(KEPT.read_text())["kitti"]
    other = json.loads(json.dumps(kept))
    other["vel_mps"][2][1] += 0.01
    other["rph_deg"][0][2] += 359.9999
    said = moved(kept, other)
    assert len(said) == 1 and said[0].startswith(f"vel_mps[1] at {kept['t_s'][2]:.2f} s")
    assert moved(kept, kept | {"used": 3}) == [f"used: {kept['used']} is now 3"]


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    os.environ.setdefault("JAXNAV_DATA_DIR", "../shared/data")
    rows = [f' "{name}": {json.dumps(solution(name))}' for name in SIMULATED | RECORDED]
    KEPT.write_text("{\n" + ",\n".join(rows) + "\n}\n")
