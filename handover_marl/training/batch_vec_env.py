"""Stable-Baselines3's VecEnv over batches of environments, one batch in each of some processes."""

import multiprocessing
import pickle
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.envs.vector_env import HandoverVectorEnv
from handover_marl.errors import WorkerError

#: Makes a batch of so many environments that begin anew in the step that ends an episode.
MakeBatch = Callable[[int], HandoverVectorEnv]


class BatchVecEnv(VecEnv):
    """Environments spread evenly over processes, each of which simulates its share at once.

    Physics of a batch run on threads, what environments do in between on one; so several cores are best used by as
    many processes. What an environment plays depends on neither.

    Args:
        count: How many environments.
        processes: How many processes.
        make: Makes a share of them.

    Raises:
        WorkerError: A process does not start.
    """

    def __init__(self, count: int, processes: int, make: MakeBatch) -> None:
        shares = [len(share) for share in np.array_split(np.arange(count), min(processes, count))]
        self._ends = np.cumsum(shares).tolist()
        context = multiprocessing.get_context("forkserver")
        self._pipes, self._processes = [], []
        for share in shares:
            own, theirs = context.Pipe()
            order = cloudpickle.dumps((make, share))
            process = context.Process(target=_serve, args=(theirs, order), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(own)
            self._processes.append(process)
        self._closed = False
        spaces, *_ = self._answers()
        super().__init__(count, *spaces)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start an episode in every environment."""
        for number, seeds in enumerate(self._shares(self._seeds)):
            self._ask(number, "reset", list(seeds))
        self._reset_seeds()
        self._reset_options()
        return np.concatenate(self._answers())

    def step_async(self, actions: npt.NDArray[np.floating]) -> None:
        """Let all environments act."""
        for number, share in enumerate(self._shares(actions)):
            self._ask(number, "step", np.asarray(share))

    def step_wait(self) -> tuple[Any, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """What came of it."""
        seen, rewards, ended, infos = zip(*self._answers(), strict=True)
        return (
            np.concatenate(seen),
            np.concatenate(rewards),
            np.concatenate(ended),
            [one for own in infos for one in own],
        )

    def close(self) -> None:
        """End the processes."""
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
        """Only the render mode, which is None: attributes stay in the processes.

        Raises:
            AttributeError: Another attribute is asked for.
        """
        if attr_name != "render_mode":
            raise AttributeError(f"attributes of environments in batches stay in their processes: {attr_name}")
        return [None for _ in self._get_indices(indices)] if hasattr(self, "num_envs") else [None]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not for environments in batches.

        Raises:
            AttributeError: Always.
        """
        raise AttributeError(f"attributes of environments in batches cannot be set: {attr_name}")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not for environments in batches.

        Raises:
            AttributeError: Always.
        """
        raise AttributeError(f"methods of environments in batches cannot be called: {method_name}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether environments are in wrappers of Gymnasium's: none is."""
        return [False for _ in self._get_indices(indices)]

    def _shares(self, values: Sequence[Any] | npt.NDArray[Any]) -> Iterable[Any]:
        begun = 0
        for end in self._ends:
            yield values[begun:end]
            begun = end

    def _ask(self, number: int, what: str, given: Any) -> None:
        try:
            self._pipes[number].send((what, given))
        except OSError as error:
            raise self._died(number) from error

    def _answers(self) -> list[Any]:
        return [self._answer(number) for number in range(len(self._pipes))]

    def _answer(self, number: int) -> Any:
        try:
            answer = self._pipes[number].recv()
        except (EOFError, OSError) as error:
            raise self._died(number) from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _died(self, number: int) -> WorkerError:
        return WorkerError(f"process {number} of the environments died; look for its message above")


def _serve(pipe: Connection, order: bytes) -> None:
    """What a process does with its share."""
    try:
        make, count = cloudpickle.loads(order)
        envs = make(count)
        pipe.send((envs.single_observation_space, envs.single_action_space))
        while True:
            what, given = pipe.recv()
            if what == "close":
                envs.close()
                return
            pipe.send(envs.reset(seed=given)[0] if what == "reset" else _stepped(envs, given))
    except Exception as error:
        pipe.send(_portable(error))
    except (KeyboardInterrupt, EOFError):
        return


def _stepped(envs: HandoverVectorEnv, actions: npt.NDArray[np.floating]) -> tuple[Any, ...]:
    """A step as Stable-Baselines3 wants it: one kind of end, and what was seen last with it."""
    seen, rewards, terminations, truncations, infos = envs.step(actions)
    ended = terminations | truncations
    told: list[dict[str, Any]] = [{} for _ in range(envs.num_envs)]
    for number in np.flatnonzero(ended).tolist():
        final = {key: value[number] for key, value in infos["final_info"].items() if not key.startswith("_")}
        cut_off = bool(truncations[number] and not terminations[number])
        told[number] = {**final, "terminal_observation": infos["final_obs"][number], "TimeLimit.truncated": cut_off}
    return seen, rewards.astype(np.float32), ended, told


def _portable(error: Exception) -> Exception:
    """The error, or one that says the same if it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return WorkerError(f"{type(error).__name__}: {error}")
    return error
