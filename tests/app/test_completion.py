"""What a shell completes, asked of the shell itself."""

import shutil
import subprocess

import pytest

from jaxnav.app import cli
from jaxnav.app.jobs import printed as completion
from jaxnav.app.verbs import SHELLS
from jaxnav.filters.catalogue import FILTERS

COMPLETES = """\
source {script}
COMP_WORDS=({words}); COMP_CWORD={last}; COMP_TYPE=9
_shtab_jaxnav
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def offered(tmp_path, *words):
    """What bash offers for the last of the words."""
    script = tmp_path / "jaxnav.bash"
    script.write_text(completion.script(cli.make_parser(), "bash"))
    typed = " ".join(f"'{word}'" for word in words)
    text = COMPLETES.format(script=script, words=typed, last=len(words) - 1)
    return subprocess.run(["bash", "-c", text], capture_output=True, text=True, timeout=60, check=True).stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_verbs_options_and_filters(tmp_path):
    assert set(offered(tmp_path, "jaxnav", "sm")) == set() and offered(tmp_path, "jaxnav", "simu") == ["simulate"]
    assert "--smooth" in offered(tmp_path, "jaxnav", "filter", "--s")
    assert set(offered(tmp_path, "jaxnav", "filter", "--filter", "ekf15")) == {n for n in FILTERS if n[:5] == "ekf15"}


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_gets_a_script_of_all_verbs(shell, capsys):
    assert cli.main(["completion", shell]) == 0
    printed = capsys.readouterr().out
    assert all(verb in printed for verb in cli.VERBS)


def test_without_shtab_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert cli.main(["completion", "bash"]) == 3
    assert "pip install 'jaxnav[completion]'" in capsys.readouterr().err
