"""Train one agent for a fixed partner with Stable-Baselines3's PPO.

The script needs the extra `train`, and by default MuJoCo; `--physics fast` does not need it, but is slower.

    python experiments/training/train_sb3.py --data-dir DIR --out runs/receiver
    python experiments/training/train_sb3.py --data-dir DIR --agent giver --partner yang2021 --out runs/giver

A receiver learns when to close the gripper, and to correct the approach to a grasp (action scheme `grasp_servo`). An
episode of a giver is one decision, the handover pose of the object (action scheme `offer`); the rest of the person's
motion is scripted. The policy learns from the reward of a success, on nine tenths of a training split, with evaluations
without exploration noise on the validation split. The folder gets `policy.npz` (`--receiver
learned:runs/receiver/policy.npz`), `progress.csv`, TensorBoard logs, and a checkpoint, from which `--resume` continues.
"""

import json
import math
import sys
import time
import zipfile
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecMonitor

from handover_marl.envs.custom_rewards import set_discount
from handover_marl.envs.vector.vector_env import vector_env
from handover_marl.envs.wrappers.wrapper import REWARD_PREFIX
from handover_marl.execution.options import count_available_cores
from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3
from handover_marl.learning.custom_encodings import is_reference
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.learning.training.batch_vec_env import BatchVecEnv
from handover_marl.learning.training.run_folder import (
    POLICY,
    describe_origin,
    open_run_folder,
    spawn_seeds,
    validate,
)
from handover_marl.learning.training.scene_arguments import RlArgs, run_script
from handover_marl.policies.reference import parse_policy

_CHECKPOINT = "checkpoint.zip"
# Features, action scheme and partner by default.
_DEFAULTS = {"receiver": ("close", "grasp_servo", "cooperative"), "giver": ("giver", "offer", "yang2021")}


@dataclass(frozen=True)
class Args(RlArgs):
    """Arguments of the training of one agent.

    Attributes:
        out: Folder of the run.
        agent: Agent that learns.
        partner: Policy of the other agent, with options; default: cooperative for receivers, yang2021 for givers.
        features: Name of the features that the learning agent observes, or module:name of user-defined features;
            default: close for receivers, giver for givers.
        action_scheme: Name of the learning agent's action scheme, or module:name of a user-defined scheme; default:
            grasp_servo for receivers, offer for givers.
        rewards: Reward: sparse, shaped, or module:name of a user-defined reward.
        gripper_initial_std: Initial standard deviation of a receiver's output that closes the gripper: random closing
            succeeds now and then, so it is explored more than the motion.
        num_envs: Number of environments simulated in parallel; fewer, such as 8, are better with physics other than
            mujoco.
        minutes: Largest wall-clock time (min).
        eval_interval: Number of decisions between evaluations.
        resume: Whether to continue the run in the folder `out`.
    """

    out: str = "runs/sb3"
    agent: Literal["receiver", "giver"] = "receiver"
    partner: str = ""
    features: str = ""
    action_scheme: str = ""
    rewards: str = "sparse"
    gripper_initial_std: float = 0.45
    num_envs: int = 64
    decisions: int = 500_000
    minutes: float = 24.0
    learning_rate: float = 7e-4
    discount: float = 0.97
    initial_std: float = 0.15
    eval_interval: int = 24_576
    resume: bool = False


def main(args: Args) -> Path:
    """Train the agent, from a checkpoint if `args.resume` is set and there is one; return the path of its file."""
    torch.set_num_threads(1)
    features, action_scheme, partner = _DEFAULTS[args.agent]
    args = replace(
        args.resolve_setup(),
        features=args.features or features,
        action_scheme=args.action_scheme or action_scheme,
        partner=args.partner or partner,
    )
    # `module:name` may be in the working folder, which Python does not search when it runs a script.
    sys.path.append(str(Path.cwd()))
    parse_policy("giver" if args.agent == "receiver" else "receiver", args.partner)
    # This checks arguments, so that the folder is made only for a run that can start.
    model, envs = _make_ppo(args)
    folder = open_run_folder(Path(args.out), args, args.resume, args.open_dataset().name)
    checkpoint = folder / _CHECKPOINT
    if args.resume and checkpoint.exists():
        # Without the pickled Python objects in the file, which `PPO.load` reads.
        model.set_parameters(str(checkpoint), device="cpu")
        with zipfile.ZipFile(checkpoint) as archive:
            model.num_timesteps = json.loads(archive.read("data"))["num_timesteps"]
        # Other episodes than those before the interruption.
        envs.seed(spawn_seeds(1, args.seed, model.num_timesteps)[0])
    elif args.agent == "receiver":
        with torch.no_grad():
            model.policy.log_std[-1] = math.log(args.gripper_initial_std)
    suffix = f"_{model.num_timesteps}" if model.num_timesteps else ""
    formats = [make_output_format("csv", str(folder), suffix)]
    model.set_logger(Logger(str(folder), [*formats, make_output_format("tensorboard", str(folder / "tensorboard"))]))
    deadline = time.monotonic() + 60.0 * args.minutes
    callback = TermsCallback(args.num_envs, deadline)
    while model.num_timesteps < args.decisions and time.monotonic() < deadline:
        # Environments go on where the last part of the training has left them.
        decisions = min(args.eval_interval, args.decisions - model.num_timesteps)
        model.learn(decisions, callback, reset_num_timesteps=False, progress_bar=True, log_interval=1)
        evaluate(model, args)
    envs.close()
    return folder / POLICY


def _make_ppo(args: Args) -> tuple[PPO, VecMonitor]:
    """Make an untrained model and its environments, which are seeded and run in one process per core."""
    envs = vector_env(
        args.num_envs,
        args.agent,
        args.partner,
        features=args.features,
        action_scheme=args.action_scheme,
        autoreset="same_step",
        processes=min(args.num_envs, count_available_cores()),
        rewards=set_discount(args.rewards, args.discount),
        **args.env_options,
    )
    monitored = VecMonitor(BatchVecEnv(envs))
    monitored.seed(args.seed)
    model = PPO(
        "MlpPolicy",
        monitored,
        learning_rate=args.learning_rate,
        n_steps=args.batch_size // args.num_envs,
        batch_size=args.minibatch_size,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=args.gae_lambda,
        clip_range=args.clip_range,
        policy_kwargs={"net_arch": [args.width] * 2, "log_std_init": math.log(args.initial_std)},
        seed=args.seed,
        device="cpu",
    )
    return model, monitored


class TermsCallback(BaseCallback):
    """Callback that logs the sum of each reward term over the episodes, and stops when time is up.

    Args:
        num_envs: Number of environments.
        deadline: Monotonic time at which the training stops (s).
    """

    def __init__(self, num_envs: int, deadline: float) -> None:
        super().__init__()
        self._deadline = deadline
        self._sums: list[dict[str, float]] = [defaultdict(float) for _ in range(num_envs)]

    def _on_step(self) -> bool:
        for sums, info, has_ended in zip(self._sums, self.locals["infos"], self.locals["dones"], strict=True):
            for key in info:
                if key.startswith(REWARD_PREFIX):
                    sums[key] += float(info[key])
            for key in list(sums) if has_ended else ():
                self.logger.record_mean(f"rewards/{key[len(REWARD_PREFIX) :]}", sums.pop(key))
        return time.monotonic() < self._deadline


def evaluate(model: PPO, args: Args) -> None:
    """Write the policy file, evaluate it on validation scenes, log and print the outcomes, write a checkpoint."""
    folder = Path(args.out)
    policy, part = folder / POLICY, folder / f"part_{_CHECKPOINT}"
    origin = describe_origin("train_sb3", args)
    spec = PolicySpec(args.agent, args.features, args.action_scheme, args.control_period, origin)
    write_policy(policy, spec, dense_network_from_sb3(model))
    # User-defined features and schemes were named by the caller, so they may be imported.
    trust = is_reference(args.features) or is_reference(args.action_scheme)
    learned, label = f"learned:{policy}", f"{model.num_timesteps} decisions"
    giver, receiver = (args.partner, learned) if args.agent == "receiver" else (learned, args.partner)
    report = validate(args, args.val_scenes, giver, receiver, label, physics=args.physics, trust=trust)
    for name, rate in report.rates.items():
        model.logger.record(f"evaluation/{name}", rate.mean)
    model.logger.dump(model.num_timesteps)
    model.save(part)
    part.replace(folder / _CHECKPOINT)


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
