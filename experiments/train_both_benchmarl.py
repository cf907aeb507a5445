"""Train giver and receiver at once with BenchMARL, by MAPPO or another of its algorithms.

Needs the extras `benchmarl`, `plot` and, for its default, `mujoco`; or `--physics fast`, slower.

    python experiments/train_both_benchmarl.py --dataset synthetic --out runs/benchmarl

The task is `handover_marl.training.benchmarl_task.HandoverTask`; its critics see the environment's state. The folder
gets `giver.npz` and `receiver.npz`, which need no BenchMARL, a learning curve, and a folder of BenchMARL's own logs.
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

from handover_marl.learning.network import Network
from handover_marl.training.benchmarl_task import HandoverTask, task_config
from handover_marl.training.dense_layers import dense_layers
from handover_marl.training.pair_run import PairArgs, PairRun

AGENTS = ("giver", "receiver")
ALGORITHMS = {"mappo": MappoConfig, "ippo": IppoConfig}


@dataclass(frozen=True)
class Args(PairArgs):
    """What to train, and how.

    Attributes:
        algorithm: mappo, whose critics see the state, or ippo.
    """

    out: str = "runs/benchmarl"
    algorithm: Literal["mappo", "ippo"] = "mappo"


class OutOfTimeError(KeyboardInterrupt):
    """Ends an experiment as the keyboard would: BenchMARL closes it and hands this on."""


class Assessment(Callback):
    """Evaluates before a batch is learned from, when it is time to."""

    def __init__(self, run: PairRun) -> None:
        super().__init__()
        self._run = run

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        # What was learned so far was learned from the batches before this one.
        done = self.experiment.total_frames - batch.numel()
        if self._run.due(done):
            self._run.assess(done, networks(self.experiment))
        if self._run.over(done):
            raise OutOfTimeError


def actor_layers(experiment: Experiment, agent: str) -> MultiAgentMLP:
    actor = experiment.algorithm.get_policy_for_loss(agent)
    (layers,) = [part for part in actor.modules() if isinstance(part, MultiAgentMLP)]
    return layers


def begin_near_zero(experiment: Experiment) -> None:
    """At first all do as the action schemes do with zeros."""
    for agent in AGENTS:
        layers = actor_layers(experiment, agent).params
        for tensor in layers[max(layers.keys(), key=int)].values():
            tensor.data.mul_(0.01)
    experiment.collector.update_policy_weights_()


def networks(experiment: Experiment) -> dict[str, Network]:
    """What the actors do without noise: the squashed means."""
    return {
        agent: dense_layers(
            actor_layers(experiment, agent).get_stateful_net(),
            "tanh",
            experiment.action_spec[agent, "action"].shape[-1],
        )
        for agent in AGENTS
    }


def algorithm_config(args: Args) -> AlgorithmConfig:
    config = ALGORITHMS[args.algorithm].get_from_yaml()
    config.clip_epsilon, config.lmbda = args.clip, args.trace
    config.scale_mapping = f"biased_softplus_{args.spread}"
    return config


def experiment_config(args: Args, folder: str) -> ExperimentConfig:
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr = args.discount, args.learning_rate
    config.clip_grad_val = 0.5
    config.max_n_frames = args.steps
    config.on_policy_collected_frames_per_batch = args.batch
    config.on_policy_n_envs_per_worker = args.envs
    config.parallel_collection = args.envs > 1
    config.on_policy_n_minibatch_iters = args.epochs
    config.on_policy_minibatch_size = args.minibatch
    # Evaluations are the benchmark's, see `Assessment`.
    config.evaluation, config.render = False, False
    config.loggers, config.create_json, config.save_folder = ["csv"], False, folder
    return config


def main(args: Args) -> PairRun:
    args = args.sized()
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_benchmarl")
    model = MlpConfig.get_from_yaml()
    model.num_cells = [args.width, args.width]
    experiment = Experiment(
        HandoverTask.TAKE.get_task(task_config(args)),
        algorithm_config(args),
        model,
        args.seed,
        experiment_config(args, str(run.folder.path)),
        callbacks=[Assessment(run)],
    )
    begin_near_zero(experiment)
    # Every environment its own seed; BenchMARL gives all the same.
    experiment.collector.set_seed(args.seed)
    try:
        experiment.run()
        run.assess(experiment.total_frames, networks(experiment))
    except OutOfTimeError:
        pass
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
