"""How long a receiver waits before it comes."""

from handover_marl.errors import OptionError

_LONGEST = 60.0  # s


def wait_ms(wait: float) -> int:
    """A wait (s) in whole milliseconds.

    Raises:
        OptionError: It is no time from 0 to 60 s.
    """
    if isinstance(wait, bool) or not isinstance(wait, (int, float)) or not 0.0 <= wait <= _LONGEST:
        raise OptionError(f"wait={wait!r} must be a time from 0 to {_LONGEST:g} s")
    return round(1000.0 * wait)
