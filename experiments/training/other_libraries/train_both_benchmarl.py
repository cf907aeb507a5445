"""Train giver and receiver together with BenchMARL, by MAPPO or another of its algorithms.

The script needs the extras `benchmarl` and `plot`, and by default MuJoCo; `--physics fast` does not need it, but
is slower.

    python experiments/training/other_libraries/train_both_benchmarl.py --dataset synthetic --out runs/benchmarl

The task is `handover_marl.learning.training.benchmarl_task.HandoverTask`; centralized critics
observe the environment's state. The folder gets `giver.npz` and `receiver.npz`, which need no
BenchMARL, a learning curve, and BenchMARL's own logs.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import tyro
from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.algorithms.common import AlgorithmConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDictBase
from torchrl.modules import MultiAgentMLP

from handover_marl.envs.arguments import AGENTS
from handover_marl.learning.adapters.torch_modules import dense_network_from_layers
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.learning.training.arguments import PairArgs
from handover_marl.learning.training.benchmarl_task import HandoverTask, make_task_config
from handover_marl.learning.training.training_run import TrainingRun

ALGORITHMS = {"mappo": MappoConfig, "ippo": IppoConfig}


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training of giver and receiver with BenchMARL.

    Attributes:
        algorithm: Algorithm: mappo, whose critics observe the state, or ippo.
    """

    out: str = "runs/benchmarl"
    algorithm: Literal["mappo", "ippo"] = "mappo"


class OutOfTimeError(KeyboardInterrupt):
    """Exception that ends the training when its time limit has passed.

    BenchMARL closes the experiment and raises the exception again.
    """


class EvaluationCallback(Callback):
    """Callback that records reward terms, and evaluates the policies at regular intervals before an update."""

    def __init__(self, run: TrainingRun) -> None:
        super().__init__()
        self._run = run

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        # The policies were trained on all batches before this one.
        decisions = self.experiment.total_frames - batch.numel()
        for agent in AGENTS:
            self._run.rewards.add_batch(agent, batch["next", agent, "info"], batch["next", "done"].flatten())
        self._run.rewards.write_point(self.experiment.total_frames)
        if self._run.evaluate_if_due(decisions, lambda: extract_policy_networks(self.experiment)):
            raise OutOfTimeError


def actor_layers(experiment: Experiment, agent: str) -> MultiAgentMLP:
    actor = experiment.algorithm.get_policy_for_loss(agent)
    (layers,) = [part for part in actor.modules() if isinstance(part, MultiAgentMLP)]
    return layers


def scale_last_layers(experiment: Experiment) -> None:
    """Scale the last layers of the policies so that their initial outputs are near zero."""
    for agent in AGENTS:
        layers = actor_layers(experiment, agent).params
        for tensor in layers[max(layers.keys(), key=int)].values():
            tensor.data.mul_(0.01)
    experiment.collector.update_policy_weights_()


def extract_policy_networks(experiment: Experiment) -> dict[str, DenseNetwork]:
    """Return the network of each agent's mean actions, tanh included, by agent."""
    return {
        agent: dense_network_from_layers(
            actor_layers(experiment, agent).get_stateful_net(),
            "tanh",
            output="tanh",
            n_outputs=experiment.action_spec[agent, "action"].shape[-1],
        )
        for agent in AGENTS
    }


def make_algorithm_config(args: Args) -> AlgorithmConfig:
    config = ALGORITHMS[args.algorithm].get_from_yaml()
    config.clip_epsilon, config.lmbda = args.clip_range, args.gae_lambda
    config.scale_mapping = f"biased_softplus_{args.initial_std}"
    return config


def make_experiment_config(args: Args, folder: str) -> ExperimentConfig:
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr = args.discount, args.learning_rate
    config.clip_grad_val = 0.5
    config.max_n_frames = args.decisions
    config.on_policy_collected_frames_per_batch = args.batch_size
    config.on_policy_n_envs_per_worker = args.num_envs
    config.parallel_collection = args.num_envs > 1
    config.on_policy_n_minibatch_iters = args.epochs
    config.on_policy_minibatch_size = args.minibatch_size
    # `EvaluationCallback` evaluates instead.
    config.evaluation, config.render = False, False
    config.loggers, config.create_json, config.save_folder = ["csv"], False, folder
    return config


def main(args: Args) -> TrainingRun:
    args = args.shrink_for_smoke_test()
    torch.set_num_threads(1)
    run = TrainingRun(args, "other_libraries/train_both_benchmarl", args.encodings)
    model = MlpConfig.get_from_yaml()
    model.num_cells = [args.width, args.width]
    experiment = Experiment(
        HandoverTask.TAKE.get_task(make_task_config(args)),
        make_algorithm_config(args),
        model,
        args.seed,
        make_experiment_config(args, str(run.folder.path)),
        callbacks=[EvaluationCallback(run)],
    )
    scale_last_layers(experiment)
    # BenchMARL gives all environments the same seed.
    experiment.collector.set_seed(args.seed)
    try:
        experiment.run()
        run.evaluate(experiment.total_frames, extract_policy_networks(experiment))
    except OutOfTimeError:
        pass
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
