"""Human-to-robot object handovers as a two-agent PettingZoo environment."""

from handover_marl._version import __version__

__all__ = ["__version__"]
