"""Time limit for tests of code that might never end."""

import contextlib
import signal
from collections.abc import Iterator


class TooSlowError(BaseException):
    """Error of an exceeded time limit; it is no `Exception`, so that the code under test does not catch it."""


@contextlib.contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Fail if the body does not end within some seconds, e.g. because it waits for the writer of a pipe."""

    def stop(*_: object) -> None:
        raise TooSlowError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
