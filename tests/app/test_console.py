"""The command line as a process: what a signal does to it, whenever it comes."""

import signal
import subprocess
import sys
import time

import pytest


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)


def test_process_has_no_traceback():
    argv = [sys.executable, "-m", "jaxnav", "filter", "--set", "filter.nam=3"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr == "jaxnav: error: --set filter.nam=3: unknown key filter.nam: did you mean filter.name?\n"


@pytest.mark.full
@pytest.mark.parametrize("after", [0.05, 0.4, 0.9, 1.6])
def test_a_signal_while_it_imports_is_heard(after, tmp_path):
    """Ctrl-C and SIGTERM in the first seconds: no traceback, the exit code of an interrupt, nothing left behind."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a background job ignores it
        "from jaxnav.app.console import console; print(flush=True); console()"
    )
    for number, expected in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        argv = [sys.executable, "-c", code, "simulate", "--data", "urban", "--out", str(tmp_path / "r")]
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        process.stdout.readline()
        time.sleep(after)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
        assert process.returncode == expected and "Traceback" not in said
        assert list(tmp_path.iterdir()) == []


@pytest.mark.full
@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143)])
@pytest.mark.parametrize("where", ["in a callback of the garbage collector", "anywhere"])
def test_a_signal_ends_the_process_with_its_code(where, name, code):
    """In such a callback python prints the interrupt and goes on, unless told."""
    interrupt = "callback()" if where == "anywhere" else "gc.callbacks.append(callback); gc.collect()"
    begin = time.monotonic()
    done = python(
        "import gc, os, signal, time; from jaxnav.app import cli; from jaxnav.app.console import console\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a script's background job ignores it
        f"def callback(*_): gc.callbacks.clear(); os.kill(os.getpid(), signal.{name}); time.sleep(0.1)\n"
        f"def main(): {interrupt}; time.sleep(20); return 0\n"
        "cli.main = main; console()"
    )
    assert done.returncode == code and done.stderr == ""
    assert time.monotonic() - begin < 15  # the sleep was cut short
