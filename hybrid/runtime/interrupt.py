"""Ctrl-C that is heard at once, also in the middle of a long computation."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hybrid.files.replace import remove_unfinished
from hybrid.runtime.system import INTERRUPTS

INTERRUPTED = 130  # what shells report for a command that Ctrl-C has ended
# How long Python is given to come back from compiled code and to unwind by itself, seconds.
PATIENCE = 1.0
# A program that has started ravg asks for its end by closing its standard input where this variable is 1. On Windows no
# signal reaches a process without a console of its own.
STOP_WITH_STDIN = "RAVG_STOP_WITH_STDIN"


def stop_with_stdin() -> None:
    """Take the end of standard input for Ctrl-C, where `STOP_WITH_STDIN` is 1.

    Processes that this one starts inherit neither the variable nor its standard input.
    """
    if os.environ.pop(STOP_WITH_STDIN, "") != "1":
        return
    # Windows lets nobody ask about a pipe while a thread reads from it, as a child would that inherits it.
    own = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # who starts it may have it ignored

    def wait() -> None:
        while os.read(own, 4096):
            pass
        interrupt_main()

    threading.Thread(target=wait, daemon=True).start()


def is_interrupt(error: BaseException | None) -> bool:
    """Whether this is Ctrl-C. Within numba's dispatcher it comes as a SystemError, or several, that it has caused."""
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def interruptible(report: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM, or Ctrl-Break end the process within about a second, whatever it is doing.

    Python sees a signal only when compiled code returns, which may take many seconds for one stage of a large frame.
    Where no KeyboardInterrupt has left the block in `PATIENCE` seconds, a thread removes what was being written, calls
    `report` and ends the process.

    Parameters
    ----------
    report : callable
        Says what is finished. Called once, here or by this thread, and then KeyboardInterrupt goes on.
    """
    if threading.current_thread() is not threading.main_thread():  # only that one may handle signals
        yield
        return
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    left = threading.Event()

    def say() -> None:
        from hybrid.files.exr import hold_library

        with hold_library(PATIENCE):  # or the report would go where the library's messages do
            report()
            sys.stderr.flush()

    def watch() -> None:
        ours.recv(1)
        if not left.wait(PATIENCE):
            remove_unfinished()
            say()
            remove_unfinished()  # what a thread has begun to write while that was said
            os._exit(INTERRUPTED)

    before = {number: signal.signal(number, signal.default_int_handler) for number in INTERRUPTS}
    # Written to by the handler in C, at once.
    previous = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        left.set()
        say()
        raise KeyboardInterrupt from None
    finally:
        left.set()
        signal.set_wakeup_fd(previous)
        for number, handler in before.items():
            signal.signal(number, handler)
        theirs.send(b"\0")  # wakes a watcher that nothing has woken
        watcher.join()
        ours.close()
        theirs.close()
