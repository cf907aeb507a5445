"""Training run: folder, clock, and evaluation of the policies on the validation split."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.learning.encodings.choices import is_reference
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.learning.training.arguments import PairArgs, PpoArgs
from handover_marl.learning.training.learning_curve import CurvePoint
from handover_marl.learning.training.reward_curve import RewardCurve
from handover_marl.learning.training.run_folder import POLICY, RunFolder, describe_origin


class TrainingRun:
    """Run of a training script with its folder, clock and evaluations.

    Policies are written as `policy.npz`, or as `giver.npz` and `receiver.npz` if both agents learn.

    Args:
        args: Arguments of the training.
        script: Name of the script, which the policy files record.
        encodings: Pair of the names of features and action scheme, by learning agent.
        partners: Name of the policy of each agent that does not learn, by agent.

    Attributes:
        folder: Folder of the run.
        rewards: Curve of the reward terms, `reward_terms.csv` in the folder.
    """

    def __init__(
        self,
        args: PairArgs | PpoArgs,
        script: str,
        encodings: Mapping[str, tuple[str, str]],
        partners: Mapping[str, str] | None = None,
    ) -> None:
        args = args.resolve_setup()
        self._args, self._encodings, self._partners = args, encodings, dict(partners or {})
        data = open_dataset(args.dataset, args.data_dir)
        self.folder = RunFolder(Path(args.out), args, getattr(args, "resume", None), data.name)
        self.rewards = RewardCurve(self.folder.path / "reward_terms.csv", getattr(args, "resume", False))
        self._origin = describe_origin(script, args)
        val = select_scenes_evenly(data.list_scenes(args.setup, "val"), args.val_scenes)
        self._config = EvaluationConfig(args.setup, "val", val, args.dataset, args.data_dir, args.physics)
        self._earlier, self._started = self.folder.seconds, time.monotonic()
        self._next_evaluation = 0

    @property
    def seconds(self) -> float:
        """Wall-clock time of the training run, including the time before it was resumed (s)."""
        return self._earlier + time.monotonic() - self._started

    @property
    def is_out_of_time(self) -> bool:
        """Whether the time limit of the training run has passed."""
        return self.seconds > 60.0 * self._args.minutes

    def is_finished(self, decisions: int) -> bool:
        """Return whether training must end after a number of decisions.

        Training ends when the limit of decisions or the limit of wall-clock time is reached.
        """
        return decisions >= self._args.decisions or self.is_out_of_time

    def get_policy_path(self, agent: str) -> Path:
        """Return the path of an agent's policy file."""
        return self.folder.path / (POLICY if len(self._encodings) == 1 else f"{agent}.npz")

    def discard_points_after(self, decisions: int) -> None:
        """Discard evaluations and reward terms after a number of decisions; a resumed run repeats them."""
        self.folder.discard_points_after(decisions)
        self.rewards.discard_points_after(decisions)

    def is_evaluation_due(self, decisions: int) -> bool:
        """Return whether an evaluation is due after a number of decisions.

        Evaluations are due at the start, at every `eval_interval` and at the end.
        """
        if self.folder.points and self.folder.points[-1].steps == decisions:
            return False
        return decisions >= self._next_evaluation or self.is_finished(decisions)

    def evaluate_if_due(self, decisions: int, make_networks: Callable[[], Mapping[str, DenseNetwork]]) -> bool:
        """Evaluate the policies if an evaluation is due; return whether the training is finished.

        Args:
            decisions: Number of decisions so far.
            make_networks: Function that returns the current policy network of each learning agent.
        """
        if self.is_evaluation_due(decisions):
            self.evaluate(decisions, make_networks())
        return self.is_finished(decisions)

    def evaluate(self, decisions: int, networks: Mapping[str, DenseNetwork]) -> CurvePoint:
        """Write the policies, evaluate them on the validation scenes and extend the learning curve.

        Args:
            decisions: Number of decisions so far.
            networks: Current policy network of each learning agent.
        """
        interval = self._args.eval_interval
        self._next_evaluation = decisions - decisions % interval + interval
        for agent, network in networks.items():
            spec = PolicySpec(agent, *self._encodings[agent], self._args.control_period, self._origin)
            write_policy(self.get_policy_path(agent), spec, network)
        policies = self._partners | {agent: f"learned:{self.get_policy_path(agent)}" for agent in networks}
        config = replace(self._config, **policies)  # type: ignore[arg-type]
        # User-defined features and schemes were named by the caller, so they may be imported.
        trust = any(is_reference(name) for names in self._encodings.values() for name in names)
        report = evaluate_pair(config, execution=ExecutionConfig(progress=False, trust=trust))
        partner = ", ".join(self._partners.values()) or "each other"
        point = CurvePoint.from_report(report, decisions, self.seconds, partner)
        self.folder.add(point)
        print(point.summarize(self.folder.unit), flush=True)
        return point
