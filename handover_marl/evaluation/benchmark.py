"""Evaluation of receivers and givers by the official protocol: one episode per scene of a split."""

import contextlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

from typing_extensions import Unpack

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import (
    REPLAY,
    REPLAYS_NONE,
    EvaluationConfig,
    EvaluationOptions,
    ExecutionConfig,
    build_configs,
    resolve_config,
)
from handover_marl.evaluation.episode_runner import SceneTask, run_episodes
from handover_marl.evaluation.progress import BenchmarkProgress
from handover_marl.evaluation.replays import ReplayWriter, check_replay_options
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import write_report
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.evaluation.results.result_folder import ResultFolder
from handover_marl.evaluation.shards import Shard
from handover_marl.evaluation.writers import EpisodeWriter
from handover_marl.execution.options import PoolConfig, check_pool, forward_signature
from handover_marl.execution.pool import Pool
from handover_marl.execution.tasks import open_pool
from handover_marl.policies.reference import PolicyLike


@forward_signature(EvaluationConfig, ExecutionConfig, without=("giver", "world_config"))
def benchmark(
    setup: str | EvaluationConfig | None = None,
    split: str = "test",
    receiver: PolicyLike = "yang2021",
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> Report:
    """Evaluate a receiver by HandoverSim's official protocol.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; or a whole `handover_marl.EvaluationConfig`.
        split: "train", "val" or "test".
        receiver: A registered name, with options or a file (`"omg:wait=1.5"`,
            `"learned:policy.npz"`), a class or an instance; see `handover_marl.policies.reference`.
        execution: Execution settings; or pass its fields as options.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        UnknownNameError: Unknown setup, split, dataset, physics or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (checked first) or damaged.
        ResultsError: `out` holds another evaluation or cannot be written.
        ActionError: The receiver returned a malformed action.
        PolicyError: The receiver's code failed.
        OptionError: `workers` is less than one, or the world or the giver is not the official one.
        WorkerError: Two worker processes died over the same scene.
    """
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver)
    if config.world_config != OFFICIAL_CONFIG:
        raise OptionError("the official benchmark requires the official world and rules; use evaluate_pair for others")
    if config.giver != REPLAY:
        raise OptionError(f"the official giver is {REPLAY!r}; use evaluate_pair for others")
    return Evaluation(config, execution).run()


@forward_signature(EvaluationConfig, ExecutionConfig)
def evaluate_pair(
    giver: PolicyLike | EvaluationConfig = REPLAY,
    receiver: PolicyLike = "yang2021",
    setup: str | None = None,
    split: str = "test",
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> Report:
    """Evaluate a giver with a receiver on the scenes of a split, under the official or other rules.

    Args:
        giver: The person's policy, given as `receiver` is; "replay" is the official giver. Or a
            whole `handover_marl.EvaluationConfig`.
        receiver: The robot's policy: a registered name, a class or an instance, as for `benchmark`.
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train", "val" or "test". The command `pair` evaluates "val" by default.
        execution: Execution settings; or pass its fields as options.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        HandoverError: The same errors as `benchmark`.
    """
    if isinstance(giver, EvaluationConfig):
        config, execution = build_configs(giver, options, execution)
    else:
        config, execution = build_configs(setup, options, execution, split=split, giver=giver, receiver=receiver)
    return Evaluation(config, execution).run()


class Evaluation:
    """Evaluation of one giver with one receiver on the scenes of a split.

    Args:
        config: Scenes, policies and simulation.
        execution: Workers, output folder and replays.
        recorded: Description of recordings kept beside the results, which identifies the result
            folder together with the configuration.

    Attributes:
        config: Resolved configuration, with the scenes of the selected shard.
        folder: Result folder, or None without `execution.out`.

    Raises:
        HandoverError: The same errors as `benchmark`.
    """

    def __init__(self, config: EvaluationConfig, execution: ExecutionConfig, recorded: str = "") -> None:
        if execution.replays != REPLAYS_NONE:
            check_replay_options(execution)
        check_pool(execution)
        shard = None if execution.shard is None else Shard.parse(execution.shard)
        self.config, dataset = resolve_config(config, execution.trust)
        split_ids = dataset.list_scenes(self.config.setup, config.split)
        shard_text = ""
        if shard is not None and self.config.scenes is not None:
            scenes = self.config.scenes
            shard_text = str(replace(shard, scenes=None if scenes == split_ids else scenes))
            self.config = replace(self.config, scenes=shard.select(scenes))
        self._execution = execution
        self._metadata = ResultMetadata.from_config(self.config, recorded, shard_text, len(split_ids))
        self._n_split_scenes = len(split_ids)
        self.folder: ResultFolder | None = None
        if execution.folder is not None:
            self.folder = ResultFolder(execution.folder, self._metadata, self.config.world_config, execution.fresh)
        indices = {scene: index for index, scene in enumerate(split_ids)}
        self._tasks = [
            SceneTask(indices[scene], scene, dataset.compute_fingerprint(scene)) for scene in self.config.scenes or ()
        ]

    def run(self, writers: Sequence[EpisodeWriter] = (), open_workers: Callable[[], Pool] | None = None) -> Report:
        """Simulate the scenes that have no result yet, write the report and return it.

        Args:
            writers: Writers of further files for each episode; they require an output folder.
            open_workers: Function that returns the worker pool, called if a scene has no result yet; default: a new
                pool with the execution settings.

        Raises:
            HandoverError: The same errors as `benchmark`.
        """
        all_writers = self._collect_writers(writers)
        stored = self._read_stored_results()
        results = {
            task: result for task, result in stored.items() if all(writer.contains(result) for writer in all_writers)
        }
        remaining = [task for task in self._tasks if task not in results]
        # Without tasks there is no need to connect to a cluster.
        pool = (open_workers or self._open_pool)() if remaining else open_pool(PoolConfig(workers=1))
        with (
            self._show_progress(results.values()) as progress,
            contextlib.closing(run_episodes(self.config, remaining, pool, all_writers)) as finished,
        ):
            for _, episode in finished:
                _check_same_outcome(stored.get(episode.task), episode.result)
                for writer, content in zip(all_writers, episode.contents, strict=True):
                    writer.write(episode.result, content)
                results[episode.task] = episode.result
                if progress is not None:
                    progress.add(episode.result)
        episodes = tuple(results[task] for task in self._tasks)
        report = Report(self._metadata, episodes, self._n_split_scenes, len(self._tasks) - len(remaining))
        if self.folder is not None:
            write_report(self.folder.path, report)
        return report

    def _open_pool(self) -> Pool:
        return open_pool(self._execution)

    def _collect_writers(self, writers: Sequence[EpisodeWriter]) -> tuple[EpisodeWriter, ...]:
        """Return all writers, the result folder last: its files mark scenes as finished."""
        if self.folder is None:
            return tuple(writers)
        replays = self._execution.replays
        replay_writers = [] if replays == REPLAYS_NONE else [ReplayWriter(self.folder.path, replays)]
        return (*writers, *replay_writers, self.folder)

    def _show_progress(
        self, stored: Collection[EpisodeResult]
    ) -> contextlib.AbstractContextManager[BenchmarkProgress | None]:
        if not self._execution.progress:
            return contextlib.nullcontext()
        return BenchmarkProgress(len(self._tasks), stored)

    def _read_stored_results(self) -> dict[SceneTask, EpisodeResult]:
        """Read the results of an earlier run in the same folder."""
        if self.folder is None:
            return {}
        found = {task: self.folder.read(task.index, task.fingerprint) for task in self._tasks}
        return {task: result for task, result in found.items() if result is not None}


def _check_same_outcome(stored: EpisodeResult | None, current: EpisodeResult) -> None:
    """Check that an episode that is simulated again, for its replay, ends as it did before."""
    if stored is not None and _describe_end(stored) != _describe_end(current):
        raise ResultsError(
            f"replaying scene {current.scene_id} gave another outcome ({_describe_end(stored)} before, "
            f"{_describe_end(current)} now): a policy is not deterministic, or the stored result was changed. The "
            "stored result is kept; delete all results with fresh=True (--fresh)"
        )


def _describe_end(result: EpisodeResult) -> str:
    release = "no release" if result.release_step is None else f"release after {result.release_step}"
    return f"{result.status.label} after {result.steps} steps, {release}"
