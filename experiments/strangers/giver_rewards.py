"""Rewards that prefer a behaviour of the giver, for the learned givers of the population `strangers-v1`.

    PYTHONPATH=experiments/strangers python experiments/training/train_giver_sb3.py --physics mujoco --rewards
    giver_rewards:EXPANSIVE --out runs/expansive

Each reward prefers one event (as in ZSC-Eval, NeurIPS 2024); its weights were not tuned.
"""

from handover_marl.envs.rewards import GiverWeights, RewardConfig

#: Prefers handover poses far from the recorded one.
EXPANSIVE = RewardConfig(giver=GiverWeights(task=0.2, discomfort=0.5))
#: Prefers to keep the object for long.
RELUCTANT = RewardConfig(giver=GiverWeights(task=0.0, waiting=0.2))
#: Prefers a fast handover near the recorded pose.
IMPATIENT = RewardConfig(giver=GiverWeights(task=1.0, waiting=-0.3, discomfort=-0.1, effort=-0.1))
