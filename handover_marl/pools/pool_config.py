"""Which pool is meant."""

import importlib.util
from dataclasses import dataclass

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.options import check_workers

LOCAL, RAY = "local", "ray"
BACKENDS = (LOCAL, RAY)


@dataclass(frozen=True)
class PoolConfig:
    """Which workers there are to be.

    Attributes:
        workers: How many; None for one a core, of this machine or of the cluster.
        backend: "local" or "ray".
        address: Of the Ray cluster, as `ray.init` takes it; None lets Ray look itself.
    """

    workers: int | None = None
    backend: str = LOCAL
    address: str | None = None

    def check(self) -> None:
        """Look whether there can be such a pool, without asking for it.

        Raises:
            UnknownNameError: There is no such backend.
            OptionError: It cannot be.
        """
        if self.backend not in BACKENDS:
            raise UnknownNameError("backend", self.backend, BACKENDS)
        check_workers(self.workers)
        if self.backend == RAY and importlib.util.find_spec("ray") is None:
            raise OptionError("backend 'ray' needs Ray: pip install 'handover-marl[ray]'; or leave out `backend`")
        if self.backend != RAY and self.address is not None:
            raise OptionError(
                f"ray_address is {self.address!r}, but the backend is {self.backend!r}; say backend='ray'"
            )
