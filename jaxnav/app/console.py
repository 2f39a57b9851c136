"""The command line as a process: it can be stopped at any time, while it still imports as well."""

import _thread
import atexit
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from types import FrameType

INTERRUPTED, TERMINATED = 130, 143  # exit codes


class Terminated(BaseException):
    """SIGTERM: half-written files are removed, as at Ctrl-C."""


def console() -> NoReturn:
    """`jaxnav.app.cli.main` as a process, which Ctrl-C and SIGTERM end in order."""
    heard = threading.Event()

    def interrupted(number: int, frame: "FrameType | None") -> None:
        heard.set()
        raise KeyboardInterrupt

    def again(number: signal.Signals) -> None:
        heard.clear()
        while not heard.is_set():  # a signal just before a system call is heard after it only: send another
            # and not `_thread.interrupt_main` alone, which would wait for the end of a system call
            if hasattr(signal, "pthread_kill"):
                signal.pthread_kill(threading.main_thread().ident or 0, number)
            else:
                _thread.interrupt_main(number)
            heard.wait(0.2)

    def swallowed(error: "sys.UnraisableHookArgs") -> None:
        # jax hears of garbage collection; an interrupt that falls into such a callback would be printed and lost
        number = {KeyboardInterrupt: signal.SIGINT, Terminated: signal.SIGTERM}.get(error.exc_type)
        if number is not None:
            threading.Timer(0.05, again, [number]).start()  # not now: it would be lost in here as well
        else:
            sys.__unraisablehook__(error)

    def at_once(number: int, frame: "FrameType | None") -> None:
        os._exit(128 + number)  # an exception would leave a half imported library, which crashes

    def terminated(number: int, frame: "FrameType | None") -> None:
        heard.set()
        raise Terminated

    asked = signal.getsignal(signal.SIGINT)  # not to be heard where a shell runs this in the background
    if asked != signal.SIG_IGN:
        signal.signal(signal.SIGINT, at_once)
    signal.signal(signal.SIGTERM, at_once)
    from jaxnav.app.cli import main

    sys.unraisablehook = swallowed
    try:
        signal.signal(signal.SIGTERM, terminated)
        signal.signal(signal.SIGINT, asked if asked == signal.SIG_IGN else interrupted)
        code = main()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Terminated:
        code = TERMINATED
    for number in (signal.SIGINT, signal.SIGTERM):  # all is written: a signal changes nothing any more
        signal.signal(number, signal.SIG_IGN)
    sys.stdout.flush()
    sys.stderr.flush()
    if code not in (INTERRUPTED, TERMINATED):  # there the compiler's threads may still be at work, and crash its end
        atexit._run_exitfuncs()
    os._exit(code)  # a regular exit would take half a second to free memory
