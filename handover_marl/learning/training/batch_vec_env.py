"""Stable-Baselines3 VecEnv over batches of environments, one batch per process."""

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.errors import WorkerError
from handover_marl.execution.worker import make_picklable

#: Function that makes a given number of environments, which reset in the step that ends an episode.
BatchFactory = Callable[[int], HandoverVectorEnv]


class BatchVecEnv(VecEnv):
    """Stable-Baselines3 VecEnv whose environments are simulated in one batch per process.

    Threads of one process run at the same time only while they simulate, so on several cores one process
    per core is fastest. Episodes do not depend on the number of processes.

    Args:
        count: Number of environments.
        processes: Number of processes.
        make: Function that makes the environments of one process; must be picklable.

    Raises:
        WorkerError: A process does not start.
    """

    def __init__(self, count: int, processes: int, make: BatchFactory) -> None:
        sizes = [len(part) for part in np.array_split(np.arange(count), min(processes, count))]
        self._ends = np.cumsum(sizes).tolist()
        context = multiprocessing.get_context("forkserver")
        self._pipes, self._processes = [], []
        for size in sizes:
            parent, child = context.Pipe()
            process = context.Process(target=_run_worker, args=(child, cloudpickle.dumps((make, size))), daemon=True)
            process.start()
            child.close()
            self._pipes.append(parent)
            self._processes.append(process)
        self._closed = False
        spaces, *_ = self._receive_all()
        super().__init__(count, *spaces)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start an episode in each of the `count` environments; return the observations (count, n)."""
        self._send_all("reset", [list(seeds) for seeds in self._split(self._seeds)])
        self._reset_seeds()
        self._reset_options()
        return np.concatenate(self._receive_all())

    def step_async(self, actions: npt.NDArray[np.floating]) -> None:
        """Send the actions (count, m) of all environments to the processes, without waiting."""
        self._send_all("step", [np.asarray(part) for part in self._split(actions)])

    def step_wait(self) -> tuple[Any, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Return observations, rewards, ends and infos of the step that `step_async` started."""
        observations, rewards, ended, infos = zip(*self._receive_all(), strict=True)
        flat = [info for part in infos for info in part]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(ended), flat

    def call_in_processes(self, functions: Sequence[Callable[[], Any]]) -> list[Any]:
        """Call picklable functions, each in another process, and return their results.

        Args:
            functions: At most `process_count` functions. Models that they load remain in the caches of the processes.
        """
        self._send_all("call", [cloudpickle.dumps(function) for function in functions])
        return self._receive_all(len(functions))

    @property
    def process_count(self) -> int:
        """Number of processes."""
        return len(self._processes)

    def close(self) -> None:
        """Stop the processes that simulate the environments."""
        if self._closed:
            return
        self._closed = True
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            try:
                pipe.send(("close", None))
            except OSError:
                process.terminate()
            process.join()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the attribute `render_mode` of environments (None); others are not accessible.

        Raises:
            AttributeError: `attr_name` is another attribute.
        """
        if attr_name != "render_mode":
            raise AttributeError(f"attributes of environments in batches cannot be read: {attr_name}")
        return [None for _ in self._get_indices(indices)] if hasattr(self, "num_envs") else [None]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an error; attributes of environments in batches cannot be set.

        Raises:
            AttributeError: Always.
        """
        raise AttributeError(f"attributes of environments in batches cannot be set: {attr_name}")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Raise an error; methods of environments in batches cannot be called.

        Raises:
            AttributeError: Always.
        """
        raise AttributeError(f"methods of environments in batches cannot be called: {method_name}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for every environment: none has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]

    def _split(self, values: Sequence[Any] | npt.NDArray[Any]) -> Iterable[Any]:
        return (values[start:end] for start, end in zip([0, *self._ends], self._ends, strict=False))

    def _send_all(self, command: str, arguments: Iterable[Any]) -> None:
        for number, argument in enumerate(arguments):
            try:
                self._pipes[number].send((command, argument))
            except OSError as error:
                raise _worker_error(number) from error

    def _receive_all(self, count: int | None = None) -> list[Any]:
        results = []
        for number, pipe in enumerate(self._pipes[:count]):
            try:
                result = pipe.recv()
            except (EOFError, OSError) as error:
                raise _worker_error(number) from error
            if isinstance(result, Exception):
                raise result
            results.append(result)
        return results


def _worker_error(number: int) -> WorkerError:
    return WorkerError(f"process {number} of the environments died; look for its message above")


def _run_worker(pipe: Connection, pickled: bytes) -> None:
    """Simulate one batch of environments at the commands of the main process."""
    try:
        make, count = cloudpickle.loads(pickled)
        envs = make(count)
        pipe.send((envs.single_observation_space, envs.single_action_space))
        while True:
            command, argument = pipe.recv()
            if command == "close":
                envs.close()
                return
            if command == "call":
                pipe.send(cloudpickle.loads(argument)())
            else:
                pipe.send(envs.reset(seed=argument)[0] if command == "reset" else _step(envs, argument))
    except Exception as error:
        pipe.send(make_picklable(error))
    except (KeyboardInterrupt, EOFError):
        return


def _step(envs: HandoverVectorEnv, actions: npt.NDArray[np.floating]) -> tuple[Any, ...]:
    """Return a step in Stable-Baselines3's format, with final observations in the infos."""
    observations, rewards, terminations, truncations, infos = envs.step(actions)
    ended = terminations | truncations
    step_infos: list[dict[str, Any]] = [{} for _ in range(envs.num_envs)]
    for number in np.flatnonzero(ended).tolist():
        final = {key: value[number] for key, value in infos["final_info"].items() if not key.startswith("_")}
        truncated = bool(truncations[number] and not terminations[number])
        step_infos[number] = {
            **final,
            "terminal_observation": infos["final_obs"][number],
            "TimeLimit.truncated": truncated,
        }
    return observations, rewards.astype(np.float32), ended, step_infos
