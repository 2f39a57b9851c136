"""The name of a job: another one with other settings, recordings or objectives, whose checkpoint it does not take."""

import os

from jaxnav.app.config import resolve
from jaxnav.app.long import identity


def test_a_job_is_another_one_with_other_data_or_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "imu.csv").write_text("t\n1\n")
    (tmp_path / "mine.py").write_text("def loss(info, epochs, truth):\n    return 1.0\n")
    job = lambda **out: identity(
        resolve([("", {"data": {"source": "drive"}, "tune": {"objective": {"mine:loss": 1.0}}, "out": out})])
    )
    names = [job()]
    assert job() == names[0] == job(figures="none")
    os.utime(tmp_path / "drive" / "imu.csv", ns=(1, 1))
    names.append(job())
    (tmp_path / "mine.py").write_text("def loss(info, epochs, truth):\n    return 2.0\n")
    names.append(job())
    (tmp_path / "drive" / "position.csv").write_text("t\n1\n")
    names.append(job())
    assert len(set(names)) == 4
