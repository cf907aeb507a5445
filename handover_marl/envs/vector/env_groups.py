"""Environments that are simulated one after another, in groups on threads, or in a process of their own."""

import contextlib
import gc
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array
from loky.backend import get_context

from handover_marl.envs.vector.env_result import EnvGroup, EnvResult, merge_results, merge_values, select_rows
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv
from handover_marl.errors import WorkerError
from handover_marl.execution.tasks import convert_error, pickle_by_value, unpickle
from handover_marl.geometry.arrays import NUMPY_ARRAYS, Indices


class SequentialEnvGroup:
    """Group of `count` environments, each made by `make` and simulated one after another; see `EnvGroup`."""

    arrays = NUMPY_ARRAYS

    def __init__(self, make: Callable[[], WrappableEnv], count: int) -> None:
        self.envs = [make() for _ in range(count)]

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each; see `EnvGroup.reset`."""
        own_options = None if options is None else dict(options)
        starts = [
            self.envs[row].reset(seed=seed, options=own_options) for row, seed in zip(rows.tolist(), seeds, strict=True)
        ]
        observations, infos = zip(*starts, strict=True)
        agents, count = list(observations[0]), len(rows)
        zeros = [{agent: np.zeros(count, dtype) for agent in agents} for dtype in (float, bool, bool)]
        return EnvResult(self._stack(observations), zeros[0], zeros[1], zeros[2], _stack_infos(infos))

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with actions (r, ...) by agent; see `EnvGroup.step`."""
        steps = [
            self.envs[row].step({agent: values[number] for agent, values in actions.items()})
            for number, row in enumerate(rows.tolist())
        ]
        observations, *scalars, infos = zip(*steps, strict=True)
        rewards, terminated, truncated = (
            {agent: np.array([by_agent[agent] for by_agent in column]) for agent in column[0]} for column in scalars
        )
        return EnvResult(self._stack(observations), rewards, terminated, truncated, _stack_infos(infos))

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        return [env.render() for env in self.envs] if self.envs[0].render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulations."""
        for env in self.envs:
            env.close()

    def _stack(self, observations: Sequence[ByAgent]) -> ByAgent:
        stacked = {}
        for agent in observations[0]:
            space = self.envs[0].observation_space(agent)
            buffer: Any = create_empty_array(space, n=len(observations))
            stacked[agent] = concatenate(space, [by_agent[agent] for by_agent in observations], buffer)
        return stacked


def _stack_infos(infos: Sequence[ByAgent]) -> ByAgent:
    parts = ({agent: {key: np.array([info[key]]) for key in info} for agent, info in one.items()} for one in infos)
    stacked: ByAgent = merge_values(len(infos), [(np.array([row]), part) for row, part in enumerate(parts)])
    return stacked


class ThreadedEnvGroup:
    """Environments in groups that are simulated at the same time, each in its own thread; see `EnvGroup`.

    If a call is interrupted, e.g. by Ctrl+C, each group finishes this call before the group begins the next one.

    Args:
        make: Function that makes the environments of a group, given their number.
        count: Number of environments.
        n_groups: Number of groups, at most `count`.
    """

    def __init__(self, make: Callable[[int], EnvGroup], count: int, n_groups: int) -> None:
        group_rows = np.array_split(np.arange(count), n_groups)
        self._groups = [make(len(rows)) for rows in group_rows]
        self._firsts = [int(rows[0]) for rows in group_rows]
        self.arrays = self._groups[0].arrays
        self._threads = [ThreadPoolExecutor(1) for _ in self._groups]

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each; see `EnvGroup.reset`."""
        return self._map(
            rows,
            lambda group, group_rows, indices: group.reset(group_rows, [seeds[one] for one in indices], options),
        )

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent; see `EnvGroup.step`."""
        return self._map(rows, lambda group, group_rows, indices: group.step(group_rows, select_rows(actions, indices)))

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        futures = [thread.submit(group.render) for thread, group in zip(self._threads, self._groups, strict=True)]
        images = [image for future in futures for image in future.result() or ()]
        return images or None

    def close(self) -> None:
        """Free the simulations."""
        for thread, group in zip(self._threads, self._groups, strict=True):
            thread.shutdown()
            group.close()

    def _map(self, rows: Indices, function: Callable[[EnvGroup, Indices, Indices], EnvResult]) -> EnvResult:
        """Call a function for each group with some of the environments `rows` (r,), ascending, and join the results.

        The function gets a group, indices of environments in the group, and the indices of these in `rows`.
        """
        numbers = np.searchsorted(self._firsts, rows, side="right") - 1
        futures = []
        for number, (thread, group, first) in enumerate(zip(self._threads, self._groups, self._firsts, strict=True)):
            if len(indices := np.flatnonzero(numbers == number)):
                futures.append((indices, thread.submit(function, group, rows[indices] - first, indices)))
        # All groups finish before the first error is raised.
        wait([future for _, future in futures])
        return merge_results(len(rows), [(indices, future.result()) for indices, future in futures])


class ProcessEnvGroup:
    """Environments of one configuration in a process of their own; see `EnvGroup`.

    Processes run in parallel; threads do so only while MuJoCo simulates. The process starts at once; the first call
    waits for it, and raises the errors of `make`. Calls must come from threads of a `ThreadedEnvGroup`, which handle no
    signals: if a call were interrupted, the next call would receive its result.

    Args:
        make: Function that makes the environments, given their number; must be picklable by value.
        count: Number of environments.
    """

    arrays = NUMPY_ARRAYS

    def __init__(self, make: Callable[[int], EnvGroup], count: int) -> None:
        # Loky's processes do not import the main module of the program.
        context = get_context("loky")
        self._pipe, child = context.Pipe()
        self._process = context.Process(target=_run_worker, args=(child, pickle_by_value((make, count))), daemon=True)
        self._process.start()
        child.close()
        self._is_ready = self._is_closed = False

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each; see `EnvGroup.reset`."""
        result: EnvResult = self._call("reset", rows, seeds, options)
        return result

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with checked actions (r, ...) by agent; see `EnvGroup.step`."""
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
        """Call a method of the environments in the process; return its result, or raise its error or a WorkerError."""
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
    """Make environments from a pickled pair (make, count); run method calls from the pipe until it yields None."""
    # The main process may close the pipe at any time, also while the environments are being made.
    with contextlib.suppress(KeyboardInterrupt, EOFError, OSError):
        try:
            make, count = unpickle(pickled)
            envs: EnvGroup = make(count)
        except Exception as error:
            pipe.send(convert_error(error, "making environments"))
            return
        pipe.send(None)
        # The modules and models of the process stay: searching them for garbage again and again takes 2 % of the time.
        gc.freeze()
        while (call := pipe.recv()) is not None:
            name, arguments = unpickle(call)
            try:
                result = getattr(envs, name)(*arguments)
            except Exception as error:
                result = convert_error(error, name)
            pipe.send(result)
        envs.close()
