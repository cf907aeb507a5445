"""Environments that another process simulates."""

import gc
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

from loky.backend import get_context

from handover_marl.envs.vector.batch import Envs
from handover_marl.envs.vector.results import EnvResult
from handover_marl.envs.wrappers.wrapper import ByAgent
from handover_marl.errors import WorkerError
from handover_marl.execution.tasks import make_picklable, pickle_by_value, unpickle
from handover_marl.geometry.arrays import NUMPY_ARRAYS, Indices


class ProcessEnvs:
    """Environments of one configuration in a process of their own; see `batch.Envs`.

    Threads of one process run at the same time only while MuJoCo simulates; processes always do. The process
    starts at once. The first call waits for it, and raises the errors of `make`.

    Args:
        make: Function that makes a number of environments; must be picklable by value.
        count: Number of environments.
    """

    arrays = NUMPY_ARRAYS

    def __init__(self, make: Callable[[int], Envs], count: int) -> None:
        # Loky's processes do not import the main module of the program.
        context = get_context("loky")
        self._pipe, child = context.Pipe()
        self._process = context.Process(target=_run_worker, args=(child, pickle_by_value((make, count))), daemon=True)
        self._process.start()
        child.close()
        self._is_ready = self._is_closed = False

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each."""
        result: EnvResult = self._call("reset", rows, seeds, options)
        return result

    def check_actions(self, actions: ByAgent) -> ByAgent:
        """Check the actions (n, ...) of all environments, and return them as `step` takes them."""
        checked: ByAgent = self._call("check_actions", actions)
        return checked

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent."""
        result: EnvResult = self._call("step", rows, actions)
        return result

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        images: list[Any] | None = self._call("render")
        return images

    def close(self) -> None:
        """End the process."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._pipe.send(None)
        except OSError:
            self._process.terminate()
        self._process.join()
        self._pipe.close()

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call a method of the environments in the process.

        Raises:
            WorkerError: The process has died.
            HandoverError: The errors of the method.
        """
        try:
            if not self._is_ready:
                self._receive()
                self._is_ready = True
            self._pipe.send(pickle_by_value((name, arguments)))
            return self._receive()
        except (EOFError, OSError) as error:
            raise WorkerError(
                f"process {self._process.pid} of the environments died; look for its message above"
            ) from error

    def _receive(self) -> Any:
        result = self._pipe.recv()
        if isinstance(result, Exception):
            raise result
        return result


def _run_worker(pipe: Connection, pickled: bytes) -> None:
    """Simulate environments at the calls of the main process, until it closes the pipe or sends None."""
    try:
        make, count = unpickle(pickled)
        envs: Envs = make(count)
    except Exception as error:
        pipe.send(make_picklable(error))
        return
    pipe.send(None)
    # The modules and models of the process stay: searching them for garbage again and again takes 2 % of the time.
    gc.freeze()
    try:
        while (call := pipe.recv()) is not None:
            name, arguments = unpickle(call)
            try:
                result = getattr(envs, name)(*arguments)
            except Exception as error:
                result = make_picklable(error)
            pipe.send(result)
        envs.close()
    except (KeyboardInterrupt, EOFError, OSError):
        return
