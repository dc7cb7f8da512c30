"""Ctrl-C that ends the process within a second, also during a long computation."""

import os
import signal
import socket
import sys
import threading
from _thread import interrupt_main
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from hybrid.files.replace import remove_unfinished
from hybrid.runtime.system import INTERRUPTS

INTERRUPTED = 130  # what shells report for a command that Ctrl-C has ended
PATIENCE = 1.0  # seconds for Python to return from compiled code and to unwind
# If this variable is 1, the program that started ravg stops it by closing its standard input. On Windows no signal
# reaches a process without a console of its own.
STOP_WITH_STDIN = "RAVG_STOP_WITH_STDIN"


def stop_with_stdin() -> None:
    """Treat the end of standard input as Ctrl-C if `STOP_WITH_STDIN` is 1; child processes inherit neither."""
    if os.environ.pop(STOP_WITH_STDIN, "") != "1":
        return
    # Windows blocks queries of a pipe while a thread reads from it; a child that inherits the pipe would query it.
    stdin = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the parent process may have set it to be ignored

    def wait() -> None:
        while os.read(stdin, 4096):
            pass
        interrupt_main()

    threading.Thread(target=wait, daemon=True).start()


def is_interrupt(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C: numba's dispatcher raises SystemError, or several, caused by KeyboardInterrupt."""
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def _as_ctrl_c(numbers: Iterable[int]) -> Iterator[bool]:
    """Treat signals as Ctrl-C; False, and nothing done, outside the main thread, which alone may handle signals."""
    if threading.current_thread() is not threading.main_thread():
        yield False
        return
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield True
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def terminable() -> Iterator[None]:
    """Treat SIGTERM, and Ctrl-Break, as Ctrl-C."""
    with _as_ctrl_c(number for number in INTERRUPTS if number != signal.SIGINT):
        yield


@contextmanager
def interruptible(report: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM, or Ctrl-Break end the process within about a second.

    Python handles a signal only when compiled code returns, which may take many seconds for one stage of a large frame.
    If no KeyboardInterrupt has left the block in `PATIENCE` seconds, a thread removes unfinished files, calls `report`
    and ends the process. `report` logs what is finished; it is called once, and KeyboardInterrupt is raised again.
    """
    with _as_ctrl_c(INTERRUPTS) as handled:
        if handled:
            with _watched(report):
                yield
        else:
            yield


@contextmanager
def _watched(report: Callable[[], None]) -> Iterator[None]:
    """End the process where KeyboardInterrupt does not leave the block in time; `report` is called once."""
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    left = threading.Event()

    def say() -> None:
        from hybrid.files.exr import hold_library

        with hold_library(PATIENCE):  # else the report would be captured with the library's messages
            report()
            sys.stderr.flush()

    def watch() -> None:
        # A byte for each signal that has a handler, as libraries set them for ended child processes; 0 ends the watch.
        while ours.recv(1)[0] not in (0, *INTERRUPTS):
            pass
        if not left.wait(PATIENCE):
            remove_unfinished()
            say()
            remove_unfinished()  # files that a thread began to write during the report
            os._exit(INTERRUPTED)

    # The C-level signal handler writes to it at once.
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
        theirs.send(b"\0")  # ends the watcher
        watcher.join()
        ours.close()
        theirs.close()
