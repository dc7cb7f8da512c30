"""The standard streams of the process: descriptors 0, 1 and 2."""

import os


def open_standard_streams() -> None:
    """Open the null device on each closed standard descriptor, as after ``2>&-``.

    Otherwise the next opened file would get that number, and libraries would print into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
