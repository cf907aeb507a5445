"""What must come to an end soon."""

import contextlib
import signal
from collections.abc import Iterator


class TooSlowError(BaseException):
    """Nothing that code under test would catch and tell otherwise."""


@contextlib.contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Fail instead of waiting for ever, e.g. for somebody to write into a pipe."""

    def stop(*_: object) -> None:
        raise TooSlowError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
